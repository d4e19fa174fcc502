"""The running prompt: where what is recalled stands, how much of it, and what a memory may do to the conversation."""

from __future__ import annotations

import pytest

from agentspec.context import Context
from agentspec.llm.base import Message, assistant, system, user
from agentspec.tokens import clip_text
from agentspec.types import Recall, RecallItem


def words(text: str) -> int:
    return len(text.split())


def recall(*texts: str, kind: str = "episodic", newest_first: bool = False) -> Recall:
    """Items that matter the more the later they are listed (or the other way round)."""
    sign = -1 if newest_first else 1
    return Recall(tuple(RecallItem(t, kind=kind, priority=sign * i) for i, t in enumerate(texts)))


def test_what_matters_least_is_dropped_first_and_the_order_stays() -> None:
    # Each item: 2 words and a line break; 8 = 2 + (1 + 2) + (1 + 2): three items of four fit exactly.
    assert recall("a 1", "b 2", "c 3", "d 4").render(8, words) == "b 2\nc 3\nd 4"
    assert recall("a 1", "b 2", "c 3", "d 4", newest_first=True).render(8, words) == "a 1\nb 2\nc 3"
    # Of equals, what is listed last goes first.
    assert Recall(tuple(RecallItem(t) for t in ("a 1", "b 2", "c 3"))).render(5, words) == "a 1\nb 2"


def test_one_item_over_budget_is_clipped_and_not_lost() -> None:
    sheet = "x" * 640
    # 512 tokens of one character each: 508 of the sheet and the mark of 4.
    assert Recall((RecallItem(sheet),)).render(512, len) == "x" * 508 + " ..."
    shown = recall("y" * 100, "z" * 20).render(60, len)
    # The 20 that matter more, a line break, and 39 left for the other: 35 and the mark.
    assert shown == "y" * 35 + " ...\n" + "z" * 20
    # What would be a scrap of fewer than 8 tokens is left out.
    assert recall("y" * 100, "z" * 20).render(27, len) == "z" * 20
    assert Recall().render(10, len) == "" and Recall((RecallItem("long"),)).render(0, len) == ""


@pytest.mark.parametrize("budget", [0, 3, 4, 5, 9, 10, 11])
def test_clipped_text_is_within_its_budget(budget: int) -> None:
    shown = clip_text("0123456789", budget, len)
    assert len(shown) <= budget
    assert shown == "0123456789" if budget >= 10 else shown in ("", "0123456789"[: budget - 4] + " ...")


def test_lessons_have_a_budget_of_their_own() -> None:
    context = Context(recall_tokens=2, lesson_tokens=2, count_tokens=words)
    both = Recall(recall("look left", kind="lesson").items + recall("went right").items)
    assert context.recalled(both) == "Lessons from earlier trials:\nlook left\n\nMemory:\nwent right\n\n"
    assert context.recalled(Recall()) == ""


def step(context: Context, number: int, remembered: str) -> tuple[Message, ...]:
    text = context.recalled(recall(remembered)) if remembered else ""
    prompt = context.prompt("task", f"{text}observation {number}")
    context.close((f"ACT{number}()",))
    return prompt


def test_what_is_recalled_stands_in_the_newest_turn_only() -> None:
    context = Context()
    step(context, 0, "sheet 0")
    assert step(context, 1, "sheet 1") == (
        system("task"),
        user("observation 0"),
        assistant("ACT0()"),
        user("Memory:\nsheet 1\n\nobservation 1"),
    )
    assert "sheet" not in "".join(m.text for m in context.messages)


def test_what_is_recalled_can_be_kept() -> None:
    context = Context(recall="kept")
    first = step(context, 0, "sheet 0")
    second = step(context, 1, "sheet 1")
    assert second[:2] == first and second[-1] == user("Memory:\nsheet 1\n\nobservation 1")


def test_a_thought_of_the_step_still_sees_what_was_recalled() -> None:
    context = Context()
    context.prompt("task", context.recalled(recall("sheet")) + "observation")
    follow_up = context.think(("hm",), "Act.")
    assert follow_up[1] == user("Memory:\nsheet\n\nobservation")
    context.close(("GO()",))
    assert context.messages[1:] == (user("observation"), assistant("hm"), user("Act."), assistant("GO()"))


def test_text_that_looks_recalled_but_is_observed_stays() -> None:
    context = Context()
    step(context, 0, "x")
    context.prompt("task", "Memory:\nx\n\nobservation")
    context.close(("GO()",))
    assert context.messages[-2] == user("Memory:\nx\n\nobservation")


def test_eviction_forgets_whole_steps_and_carries_a_text() -> None:
    context = Context(window=100, count_tokens=words)
    for i in range(3):
        context.prompt("task", f"observation {i}")
        context.think((f"thought {i}",), "Act.")
        context.close((f"ACT{i}()",))
    # 1 word of the task; per step: observation 2, thought 2, request 1, action 1.
    assert (context.steps, context.tokens(), context.window) == (3, 1 + 3 * 6, 100)
    gone = context.evict(1, "You were in the hall.")
    assert [m.text for m in gone] == [
        "observation 0",
        "thought 0",
        "Act.",
        "ACT0()",
        "observation 1",
        "thought 1",
        "Act.",
        "ACT1()",
    ]
    assert context.steps == 1
    prompt = context.prompt("task", "observation 3")
    assert [m.text for m in prompt] == [
        "task",
        "You were in the hall.\n\nobservation 2",
        "thought 2",
        "Act.",
        "ACT2()",
        "observation 3",
    ]
    with pytest.raises(ValueError, match="in the middle of a step"):
        context.evict(0)
    context.close(("ACT3()",))
    assert context.evict(5) == () and context.steps == 2
    with pytest.raises(ValueError, match="keep >= 0"):
        context.evict(-1)


def test_a_snapshot_is_the_whole_conversation() -> None:
    context = Context()
    step(context, 0, "sheet 0")
    context.evict(1, "carried")
    context.prompt("task", context.recalled(recall("sheet 1")) + "observation 1")
    other = Context()
    other.restore(context.snapshot())
    for c in (context, other):
        c.close(("ACT1()",))
    assert other.messages == context.messages and other.snapshot() == context.snapshot()
    assert other.evict(1) == context.evict(1)
