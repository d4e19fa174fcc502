"""How far a batch of episodes is."""

from __future__ import annotations

import io

from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.progress import duration, episode_progress
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.toy_env import TOY


def test_a_line_every_ten_seconds_with_an_estimate() -> None:
    now, out = [0.0], io.StringIO()
    after = episode_progress(8, stream=out, clock=lambda: now[0])
    for at in (4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0, 32.0):
        now[0] = at
        after(None)
    # Lines at 12 s (3 of 8 in 12 s: 4 s each, 5 left) and 24 s (6 of 8); the last episode needs none.
    assert out.getvalue() == "  episode 3/8, about 20 s left\n  episode 6/8, about 8 s left\n"


def test_a_short_batch_says_nothing() -> None:
    out = io.StringIO()
    after = episode_progress(2, stream=out, clock=lambda: 0.0)
    after(None)
    after(None)
    assert out.getvalue() == ""


def test_durations() -> None:
    assert [duration(s) for s in (0.4, 89.0, 90.0, 3599.0, 3600.0, 9000.0)] == [
        *("0 s", "89 s", "2 min", "60 min", "1.0 h", "2.5 h")
    ]


def test_the_runner_tells_each_step_and_each_episode() -> None:
    steps, ended = [], []

    def progress(total: int):
        return lambda trajectory: ended.append((trajectory.task.seed, total))

    runner = Runner(
        AgentSpec(),
        ScriptedLLM(["SELL()"]),
        on_step=lambda task, t: steps.append((task.seed, t.step, t.action_text)),
        progress=progress,
    )
    runner.run([Job(Task(TOY, 0)), Job(Task(TOY, 1))])
    assert sorted(ended) == [(0, 2), (1, 2)]
    assert sorted(s for s in steps if s[0] == 1) == [(1, i, "SELL()") for i in range(5)]
