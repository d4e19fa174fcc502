"""How steps are told: what is cut, and what is not."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from agentspec.memory.parts import telling
from agentspec.memory.parts.steps import step_text
from agentspec.tokens import estimate_tokens, excerpt
from agentspec.types import Experience
from tests.memory.one_step import step


def test_a_step_is_told_with_its_thought_and_within_its_budget() -> None:
    told = telling.told(step(0, "At the mill.", "GO(1)", thought="Thought: The key is there.\nAction: GO(1)"), 200, len)
    assert told == "State: At the mill.\nThought: The key is there.\nAction: GO(1)\nResult: done"
    short = telling.told(step(0, "x" * 500, "GO(1)", thought="why " * 100 + "\nAction: GO(1)", reward=2.0), 120, len)
    assert len(short) <= 121 and short.endswith("Action: GO(1)\nResult: done\nReward: +2.00")
    assert telling.thought_of(step(0, "s", "GO(1)", thought="GO(1)")) == ""


def test_a_course_keeps_what_was_done_and_shares_the_rest_among_states() -> None:
    steps = [["a" * 100, "1. GO -> ok"], ["", "2. TAKE -> no"], ["b" * 100, "3. WAIT -> ok"]]
    # Lines and breaks: 12 + 14 + 14 = 40 of 100; 60 are left for two states: 29 and a break, then what the first left.
    told = telling.course(steps, 100, len).splitlines()
    assert [line for line in told if line[0] in "123"] == [line for _, line in steps]
    assert [len(line) for line in told if line.startswith("State: ")] == [29, 29] and len("\n".join(told)) == 99
    assert telling.course(steps, 45, len) == "1. GO -> ok\n2. TAKE -> no\n3. WAIT -> ok"  # no room to say anything
    # No room for all of them: the newest and the first ones stay, and how many are missing is said.
    assert telling.course(steps, 20, len) == "3. WAIT -> ok"
    many = [["", f"{i}. GO -> ok"] for i in range(1, 8)] + [["", "It failed."]]
    left = "(5 steps between these are left out)"
    assert telling.course(many, 74, len) == f"1. GO -> ok\n{left}\n7. GO -> ok\nIt failed."
    assert telling.course(many, 8, len) == "It f ..."
    assert telling.course([["s", "1. GO -> ok"]], 40, len) == "State: s\n1. GO -> ok"


def test_what_fits() -> None:
    assert telling.newest_that_fit(["aaaa", "bb", "cc"], 6, len) == ["bb", "cc"]
    assert telling.newest_that_fit(["a" * 10], 8, len) == ["aaaa ..."]
    assert telling.within(["aa", "bb", "c"], 6, len) == ["aa", "bb"]


def test_an_excerpt_of_an_observation_keeps_the_orders() -> None:
    state = (
        f"00:06 on the clock. {'You are on the way. ' * 20}\n\nYour orders:\n- order 9: in bag, 21 s left\n\nAround: x"
    )
    kept = excerpt(state, 48)
    assert kept.startswith("00:06 on the clock.") and "order 9: in bag, 21 s left" in kept
    assert excerpt(excerpt(state, 96), 48) == kept  # what was joined is still paragraphs
    assert excerpt("one\nparagraph only", 99) == "one paragraph only"


@given(st.text("ab c\n|", max_size=200), st.integers(0, 60))
def test_an_excerpt_stays_within_its_budget(text: str, tokens: int) -> None:
    assert excerpt(text, tokens) == "" or estimate_tokens(excerpt(text, tokens)) <= tokens
    assert len(excerpt(text, tokens, len)) <= tokens


def test_what_failed_is_never_told_as_done() -> None:
    failed = Experience.of(step(0, "s", "JUMP()", error="there is no such action", message=""))
    assert (failed.ok, failed.feedback) == (False, "there is no such action")
    silent = replace(step(0, "s", "JUMP()"), info={"invalid": True})
    assert (Experience.of(silent).ok, Experience.of(silent).line()) == (False, "1. JUMP() -> failed")
    unread = replace(step(0, "s", "JUMP()", error="no action in it"), info={})
    assert Experience.of(unread).line() == "1. JUMP() -> no action in it"
    assert step_text(silent, 0, len) == "JUMP() failed: failed"
