"""Episodes as Inspect logs: what Inspect itself reads back."""

from __future__ import annotations

from pathlib import Path

import pytest

from agentspec.cli import main
from agentspec.llm.scripted import ScriptedLLM
from agentspec.policies import Policy
from agentspec.spec import AgentSpec
from agentspec.types import Task
from eval.matrix import evaluate

log = pytest.importorskip("inspect_ai.log", reason="needs inspect-ai: pip install 'agentspec-rl[inspect]'")

REACT = AgentSpec.from_data({"reasoning": "react", "memory": "base"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("matrix")
    tasks = {"grid": [Task("minigrid", s, {"action_mode": "menu"}) for s in (0, 1)]}

    def make(_: Policy) -> ScriptedLLM:
        return ScriptedLLM(lambda r: "turn left" if r.sampling.choices else "Thought: I look around.")

    evaluate(
        [Policy("turner", "x")],
        {"react": REACT},
        tasks,
        out=out,
        make_llm=make,
        trajectories=True,
        rollouts=2,
        max_steps=3,
    )
    return out


def test_a_cell_is_a_log_a_task_a_sample_a_repeat_an_epoch(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(folder), "--to", "inspect", "--pictures"]) == 0
    assert "1 logs in" in capsys.readouterr().out
    [path] = (folder / "inspect").glob("*.eval")
    read = log.read_eval_log(str(path))
    assert read.status == "success" and read.eval.task == "grid / turner / react" and read.eval.config.epochs == 2
    assert sorted((s.epoch, s.metadata["seed"]) for s in read.samples) == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert {score.name for score in read.results.scores} >= {"success", "return"}


def test_a_step_is_a_span_with_its_modules_calls_and_answers(folder: Path) -> None:
    main(["export", str(folder), "--to", "inspect", "--out", str(folder / "again")])
    [path] = (folder / "again").glob("*.eval")
    sample = log.read_eval_log(str(path), resolve_attachments=True).samples[0]
    kinds = [event.event for event in sample.events]
    begun = [event for event in sample.events if event.event == "span_begin"]
    assert [event.name for event in begun if event.type == "step"] == ["step 0", "step 1", "step 2"]
    assert {event.name for event in begun if event.type == "module"} == {"reasoning.react"}
    assert kinds.count("span_begin") == kinds.count("span_end")
    calls = [event for event in sample.events if event.event == "model"]
    assert [event.role for event in calls] == ["think", "act"] * 3
    # The prompt is there as text, whole: what the agent was told and what it saw.
    assert "You act in a grid" in calls[1].input[0].text and calls[1].output.completion == "turn left"
    told = [event.data for event in sample.events if event.event == "info" and event.source == "environment"]
    assert [data["message"] for data in told] == ["turned left"] * 3
    assert sample.messages[0].role == "system" and len(sample.messages) == 1 + 2 * 3


def test_a_static_site_is_bundled(folder: Path, tmp_path: Path) -> None:
    main(["export", str(folder), "--to", "inspect", "--out", str(tmp_path / "logs")])
    assert main(["view", str(tmp_path / "logs"), "--bundle", str(tmp_path / "site")]) == 0
    assert (tmp_path / "site" / "index.html").is_file()
