"""The trajectory format as documented: every field, and a reader that shares no code with the package."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from agentspec.trajectory import Trajectory, read_trajectories
from tests.trainers.builders import call, episode
from tests.trainers.played import toy_trainer

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "trajectories.md").read_text(encoding="utf-8")


def _reader() -> Any:
    location = importlib.util.spec_from_file_location("trajectory_reader", DOCS / "trajectory_reader.py")
    assert location and location.loader
    module = importlib.util.module_from_spec(location)
    location.loader.exec_module(module)
    return module


READER = _reader()


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Episodes with menus and a memory that asks the model, and the model that played them (it learned nothing)."""
    folder = tmp_path_factory.mktemp("format")
    agent = {
        "reasoning": "react",
        "memory": {"name": "summary", "every": 1, "summary_tokens": 6},
        "sampling": {"max_tokens": 6, "temperature": 0.7},
    }
    trainer = toy_trainer(folder, agent=agent, learning_rate=0.0, max_steps=1)
    trainer.train()
    return folder / "trajectories" / "000000.jsonl", trainer.model


def test_the_page_shows_the_reader_that_is_tested() -> None:
    assert (DOCS / "trajectory_reader.py").read_text(encoding="utf-8") in PAGE


def test_the_reader_reads_what_the_package_reads(played: tuple[Path, Any]) -> None:
    path, _ = played
    ours, theirs = list(read_trajectories(path)), list(READER.read_episodes(path))
    assert len(ours) == len(theirs) == 4
    for a, b in zip(ours, theirs, strict=True):
        assert [list(c.prompt_ids) for c in a.calls] == [c["prompt_ids"] for c in b["calls"]]
        assert len({len(c.prompt_ids) for c in a.calls}) > 1  # not all prompts are alike
        assert [t.text for c in a.calls for t in c.completions] == [
            t["text"] for c in b["calls"] for t in c["completions"]
        ]


def test_read_log_probabilities_are_those_of_a_plain_forward_pass(played: tuple[Path, Any]) -> None:
    """`log_softmax(logits / temperature)` over what the constraint left, after exactly the prompt that was read."""
    path, model = played
    read = [token for one in READER.read_episodes(path) for token in READER.sampled_tokens(one)]
    assert any(allowed for *_, allowed in read) and any(allowed is None for *_, allowed in read)
    worst = 0.0
    for prompt, _, token, logprob, temperature, allowed in read:
        with torch.no_grad():
            logits = model(input_ids=torch.tensor([prompt])).logits[0, -1].double() / temperature
        ids = list(range(len(logits))) if allowed is None else allowed
        expected = logits[token] - logits[ids].logsumexp(0)
        worst = max(worst, abs(expected.item() - logprob))
    assert worst < 1e-5


def test_every_field_is_documented() -> None:
    record = json.loads(episode([call(0, [1, 2], [5], allowed=((5, 6),))], rewards=(1.0,)).to_json())

    def names(value: Any) -> set[str]:
        if isinstance(value, dict):
            return set(value) | {n for v in value.values() for n in names(v)}
        return {n for v in value for n in names(v)} if isinstance(value, list) else set()

    open_fields = {"spec", "versions", "metrics"}  # the agent's, the packages', the environment's own names
    known = names({k: v for k, v in record.items() if k not in open_fields}) | open_fields
    known -= set(record["steps"][0]["state"]) | set(record["steps"][0]["info"])
    assert {n for n in known if f"`{n}`" not in PAGE} == set()
    assert f"(format {record['format']})" in PAGE


def test_prompts_are_differences_that_cannot_be_mistaken_for_tokens() -> None:
    calls = [call(0, [1, 2], [5, 6]), call(1, [1, 2, 5, 6, 9], [7]), call(2, [1, 3], [8])]
    trajectory = episode(calls, rewards=(1.0,))
    stored = json.loads(trajectory.to_json())["calls"]
    # After call 0 stand 1 2 5 6; call 1 keeps all four. After call 1 stand 1 2 5 6 9 7; call 2 keeps the 1.
    assert [c["prompt"] for c in stored] == [
        {"kept": 0, "new": [1, 2]},
        {"kept": 4, "new": [9]},
        {"kept": 1, "new": [3]},
    ]
    assert all("prompt_ids" not in c for c in stored)
    assert Trajectory.from_json(trajectory.to_json()).calls == trajectory.calls


def test_format_1_is_still_read(tmp_path: Path) -> None:
    calls = [call(0, [1, 2], [5, 6]), call(1, [1, 2, 5, 6, 9], [7])]
    trajectory = episode(calls, rewards=(1.0,))
    data = json.loads(trajectory.to_json())
    data["format"] = 1
    for stored in data["calls"]:
        prompt = stored.pop("prompt")
        stored["prompt_ids"] = [prompt["kept"], *prompt["new"]]
    assert Trajectory.from_data(data).calls == trajectory.calls
    (tmp_path / "t.jsonl").write_text(json.dumps(data) + "\n{cut short")
    (read,) = READER.read_episodes(tmp_path / "t.jsonl")
    assert [c["prompt_ids"] for c in read["calls"]] == [[1, 2], [1, 2, 5, 6, 9]]


def test_what_is_no_trajectory_is_refused(tmp_path: Path) -> None:
    data = json.loads(episode([call(0, [1], [5])]).to_json())
    with pytest.raises(ValueError, match="found 3"):
        Trajectory.from_data(data | {"format": 3})
    with pytest.raises(ValueError, match="found list"):
        Trajectory.from_data([])
    data["calls"][0]["prompt"]["kept"] = 7
    with pytest.raises(ValueError, match="call 0 keeps 7 tokens of the 0 before it"):
        Trajectory.from_data(data)
    (tmp_path / "t.jsonl").write_text(json.dumps(data) + "\n")
    with pytest.raises(ValueError, match=r"t\.jsonl, line 1"):
        list(read_trajectories(tmp_path / "t.jsonl"))
