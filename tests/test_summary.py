"""SUPO's memory: summaries every K actions replace the conversation, are credited, and carry what happened."""

from __future__ import annotations

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.toy_env import TOY


def play(spec: dict, steps: int = 20) -> tuple[Trajectory, list[Request]]:
    seen: list[Request] = []

    def script(request: Request) -> str:
        seen.append(request)
        return f"note {len(seen)}" if request.tag.purpose == "summary" else "WAIT()"

    spec = {"reasoning": "direct", **spec}
    (trajectory,) = Runner(AgentSpec.from_data(spec), ScriptedLLM(script)).run([Job(Task(TOY, 0, {"steps": steps}))])
    assert trajectory.status == "completed", trajectory.error
    return trajectory, seen


def test_every_eight_actions_a_summary_replaces_the_conversation() -> None:
    trajectory, seen = play({"memory": "summary"})
    kinds = [r.tag.purpose for r in seen]
    # 20 actions: summaries after the 8th and the 16th; none after the last.
    assert kinds == ["act"] * 8 + ["summary"] + ["act"] * 8 + ["summary"] + ["act"] * 4
    # The summary sees the whole segment and the result of its last action ...
    ask = seen[8].messages
    assert sum(m.role == "assistant" for m in ask) == 8
    assert trajectory.transitions[7].next_text in ask[-1].text
    # ... the next prompt is the task and the summary, nothing else ...
    after = seen[9].messages
    assert [m.role for m in after] == ["system", "user"] and after[0] == seen[0].messages[0]
    assert "note 9" in after[1].text and trajectory.transitions[8].input.text in after[1].text
    # ... and it stays there for the rest of the segment, without earlier turns.
    assert "note 9" in seen[12].messages[1].text and len(seen[12].messages) == 2 + 2 * 3
    assert "note 9" in seen[17].messages[1].text and "note 9" not in seen[18].messages[1].text


def test_the_context_stays_flat() -> None:
    long, _ = play({"memory": "summary"}, steps=80)
    short, _ = play({"memory": "summary"}, steps=24)
    peak = lambda t: max(len(c.prompt_ids) for c in t.calls)  # noqa: E731
    assert peak(long) <= peak(short) + 8  # a step number more digits long


def test_summaries_are_executed_and_segments_are_sequences() -> None:
    from trainers.sequences import TrainFilter, build_sequences

    trajectory, _ = play({"memory": "summary"})
    assert all(c.completions[0].credit == "executed" for c in trajectory.calls)
    rows = build_sequences(trajectory, TrainFilter(("reasoning.*", "memory.summary")))
    assert len(rows) == 3  # one per segment
    summaries = [c.id for c in trajectory.calls if c.tag.purpose == "summary"]
    # A segment ends in its summary's own tokens.
    assert [r.calls[-1] for r in rows[:2]] == summaries
    untrained = build_sequences(trajectory, TrainFilter(("reasoning.*",)))
    assert all(set(summaries).isdisjoint(r.calls) for r in untrained)


def test_truncated_summaries_can_be_masked() -> None:
    from trainers.sequences import TrainFilter, build_sequences

    def script(request: Request) -> str:
        return "a summary that is far too long" if request.tag.purpose == "summary" else "WAIT()"

    spec = AgentSpec.from_data({"reasoning": "direct", "memory": {"name": "summary", "summary_tokens": 5}})
    (trajectory,) = Runner(spec, ScriptedLLM(script)).run([Job(Task(TOY, 0, {"steps": 12}))])
    (summary,) = [c for c in trajectory.calls if c.tag.purpose == "summary"]
    assert summary.completions[0].finish_reason == "length"
    kept = build_sequences(trajectory, TrainFilter(("reasoning.*", "memory.summary")))
    masked = build_sequences(trajectory, TrainFilter(("reasoning.*", "memory.summary"), mask_truncated=("memory.*",)))
    assert sum(r.trained for r in kept) == sum(r.trained for r in masked) + 5


def test_a_token_threshold_and_a_limit() -> None:
    trajectory, _ = play({"memory": {"name": "summary", "every": 0, "threshold_tokens": 600, "max_summaries": 1}})
    acts = [c for c in trajectory.calls if c.tag.purpose == "act"]
    (summary,) = [c for c in trajectory.calls if c.tag.purpose == "summary"]
    before = [len(c.prompt_ids) + len(c.completions[0].token_ids) for c in acts if c.id < summary.id]
    assert before[-1] >= 600 and all(n < 600 for n in before[:-1])


def test_the_snapshot_layout_recalls_summary_and_steps_since() -> None:
    _, seen = play({"memory": "summary", "layout": "snapshot"})
    acts = [r for r in seen if r.tag.purpose == "act"]
    assert "note 9" in acts[9].messages[-1].text and "9. WAIT()" in acts[9].messages[-1].text
    assert "8. WAIT()" not in acts[9].messages[-1].text


def test_a_schedule_is_needed() -> None:
    with pytest.raises(ValueError, match="one of them must be positive"):
        play({"memory": {"name": "summary", "every": 0}})
