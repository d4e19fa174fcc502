"""Worlds as a verifiers taskset and a scaffold as a harness: `vf-eval` scores an endpoint on loopback."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.interop.stub import endpoint

pytest.importorskip("verifiers.v1")
pytest.importorskip("minigrid")

OPTIONS = {"level": "MiniGrid-Empty-5x5-v0", "observation": "compact", "action_mode": "menu", "max_steps": 10}
SOLUTION = ("go forward", "go forward", "turn right", "go forward", "go forward")
PAID = 1 - 0.9 * 5 / 10


def solve(messages):
    """The action after as many replies as the conversation holds."""
    return SOLUTION[sum(m["role"] == "assistant" for m in messages) % 5]


def evaluate(url, folder, *more, count=2):
    program = Path(sys.executable).with_name("vf-eval")
    taskset = ["--env.taskset.world", "minigrid", "--env.taskset.options", json.dumps(OPTIONS)]
    client = ["--client.base-url", url, "--client.api-key-var", "STUB_KEY", "-m", "stub"]
    run = ["-n", str(count), "--no-push", "--no-rich", "-o", str(folder), "--run.name", "run"]
    command = [program, "agentspec-verifiers", *taskset, *client, *run, *more]
    environment = os.environ | {"STUB_KEY": "x", "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=560)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return [json.loads(line) for line in (folder / "run" / "traces.jsonl").read_text().splitlines()]


def traces(rows):
    return [trace for row in rows for trace in row.get("traces", [row])]


def test_tasks_hold_what_an_agent_is_shown():
    from agentspec.interop.verifiers import WorldConfig
    from agentspec_verifiers import WorldTaskset

    config = WorldConfig(id="agentspec-verifiers", options=OPTIONS, count=3)
    tasks = list(WorldTaskset(config))
    assert [t.data.seed for t in tasks] == [20_000, 20_001, 20_002]
    assert "Mission: get to the green goal square." in tasks[0].data.prompt
    assert "The actions are: turn left" in tasks[0].data.system_prompt
    with pytest.raises(KeyError, match="no score 'profit'; expected one of return, success"):
        list(WorldTaskset(config.model_copy(update={"score": "profit"})))


def test_vf_eval_scores_a_scaffold_in_the_seat(tmp_path):
    scaffold = tmp_path / "agent.yaml"
    scaffold.write_text("{reasoning: direct, layout: conversation, sampling: {max_tokens: 16}}")
    harness = ["--env.player.harness.id", "agentspec-verifiers", "--env.player.harness.scaffold", str(scaffold)]
    with endpoint(solve) as (url, seen):
        found = traces(evaluate(url, tmp_path, *harness))
    assert len(found) == 2 and len(seen) == 10
    for trace in found:
        assert trace["rewards"]["outcome"]["score"] == pytest.approx(PAID)
        assert trace["metrics"]["success"] == 1.0 and trace["metrics"]["llm_calls"] == 5.0
        assert sum(node.get("sampled", False) for node in trace["nodes"]) == 5


UV = shutil.which("uv", path=str(Path(sys.executable).parent))


@pytest.mark.skipif(UV is None, reason="verifiers' own loop needs uv")
def test_vf_eval_scores_an_endpoint_with_verifiers_own_loop(tmp_path):
    with endpoint(solve) as (url, seen):
        solved = traces(evaluate(url, tmp_path, count=1))
    assert solved[0]["rewards"]["outcome"]["score"] == pytest.approx(PAID) and len(seen) == 5
    assert solved[0]["metrics"]["steps"] == 5.0
    with endpoint(lambda messages: "I give up") as (url, seen):
        lost = traces(evaluate(url, tmp_path / "lost", "--env.player.max-turns", "6", count=1))
    assert lost[0]["rewards"]["outcome"]["score"] == 0.0 and len(seen) == 6
