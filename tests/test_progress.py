"""How far a batch of episodes is."""

from __future__ import annotations

import io
from typing import Any

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.policies import Policy
from agentspec.progress import duration, episode_progress, load_policy, model_progress
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


def test_the_first_prompt_is_announced_and_later_only_what_takes_long() -> None:
    now, out = [0.0], io.StringIO()
    before = model_progress(every_s=10.0, stream=out, clock=lambda: now[0])
    # Reads 1,900 tokens at 50 tokens/s, writes 4, then a second prompt within the ten seconds.
    for at, reading, written in ((0.0, 1900, 0), (10.0, 1400, 0), (12.0, 1300, 0), (38.0, 0, 0), (48.0, 0, 4)):
        now[0] = at
        before(reading, written)
    before(90, 0)
    assert out.getvalue().splitlines() == [
        "  reading a prompt of 1,900 tokens ...",
        "  read 500 of 1,900 tokens, 50.0 tokens/s, about 28 s left",
        "  0 tokens written so far ...",
        "  4 tokens written so far ...",
    ]


def test_a_local_model_tells_before_every_forward() -> None:
    pytest.importorskip("transformers")
    from agentspec.llm.local import LocalLLM
    from tests.tiny import tiny_model, tiny_tokenizer

    tokenizer, told = tiny_tokenizer(), []
    llm = LocalLLM(tiny_model(tokenizer), tokenizer, name="tiny")
    llm.watch(lambda reading, written: told.append((reading, written)))
    spec = AgentSpec.from_data({"sampling": {"max_tokens": 4}})
    [episode] = Runner(spec, llm, max_steps=1).run([Job(Task(TOY, 0))])
    call = episode.calls[0]  # an answer that is no action is asked for again
    forwards = len(call.completions[0].token_ids)
    assert told[:forwards] == [(len(call.prompt_ids), 0), *((0, n) for n in range(1, forwards))]


def test_loading_is_said_and_watched(monkeypatch: pytest.MonkeyPatch) -> None:
    class Model:
        watched = None

        def watch(self, watch: Any) -> None:
            self.watched = watch

    model, out = Model(), io.StringIO()
    monkeypatch.setattr(Policy, "build", lambda self: model)
    assert load_policy(Policy("m", "some-model"), out) is model and model.watched is not None
    assert out.getvalue() == "loading m ...\nm loaded in 0 s\n"
    out.truncate(0)
    load_policy(Policy("random"), out)
    assert not out.getvalue()


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
