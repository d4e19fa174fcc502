"""Self-Consistency: independent samples, votes over canonical actions, ties, credit; both modes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.actions import parse_action
from agentspec.llm.base import Request
from agentspec.reasoning.self_consistency import Tally, Vote
from agentspec.registry import SpecError
from agentspec.types import Action, ActionSchema
from tests.reasoning.numbers_env import ACTIONS, MENU
from tests.reasoning.player import credits_of, greedy_player, named, play, seen, solve, solved

SCHEMA = ActionSchema(ACTIONS)
SPELLINGS = ["ADD()", " add( )", "```\nADD()\n```", "DOUBLE()", "Action: double()", "SUB()", "no idea", ""]


def tally(texts: list[str]) -> Tally:
    read = [(i, text, parse_action(text, SCHEMA)) for i, text in enumerate(texts)]
    return Tally.of([Vote(a, text, ((i, 0),)) for i, text, a in read if isinstance(a, Action)], SCHEMA)


@given(st.lists(st.sampled_from(SPELLINGS), max_size=9), st.randoms(use_true_random=False))
def test_counts_do_not_depend_on_the_order(texts: list[str], rng) -> None:
    shuffled = list(texts)
    rng.shuffle(shuffled)
    one, other = tally(texts), tally(shuffled)
    assert {g[0].action.name: len(g) for g in one.groups} == {g[0].action.name: len(g) for g in other.groups}
    if one.winner is not None and other.winner is not None:
        # A majority wins in any order; among equals the order of the samples decides, by rule.
        assert len(one.groups[0]) == len(other.groups[0])
        if len(one.groups) == 1 or len(one.groups[0]) > len(one.groups[1]):
            assert one.winner.action.name == other.winner.action.name


def test_votes_ties_and_illegal_answers() -> None:
    assert tally(["SUB()", "ADD()", "add( )"]).winner.action.name == "ADD"
    assert tally(["SUB()", "ADD()", "add( )", "sub()"]).winner.action.name == "SUB"  # 2:2, the first seen
    assert tally(["nonsense", "DOUBLE()", "nonsense"]).winner.action.name == "DOUBLE"
    assert tally(["nonsense"]).winner is None
    assert tally(["SUB()", "ADD()", "add( )"]).shares == (("ADD()", 2 / 3), ("SUB()", 1 / 3))


def unsteady(request: Request):
    """Greedy first, then right three times of four: a majority that a single answer does not show."""
    number, target, left = seen("\n".join(m.text for m in request.messages if m.role == "user"))
    right = (solve(number, target, left) or ["ADD"])[0]
    if request.tag.purpose == "think":
        return [f"so ADD, number {i}" if i in (0, 2) else f"so {right}, number {i}" for i in range(request.sampling.n)]
    if request.sampling.choices:
        thought = next(m.text for m in reversed(request.messages) if m.role == "assistant" and m.text.startswith("so "))
        return named(thought.split()[1].rstrip(","), request)
    return [f"So.\nAction: {'ADD' if i in (0, 2) else right}()" for i in range(request.sampling.n)]


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("menu", [False, True])
def test_solves_what_direct_does_not(menu: bool, layout: str) -> None:
    assert not solved(play(greedy_player, {"reasoning": "direct"}, menu=menu)[0])
    trajectory, requests = play(unsteady, {"reasoning": "self_consistency", "layout": layout}, menu=menu)
    assert solved(trajectory)
    assert requests[0].sampling.n == 5 and requests[0].sampling.temperature == 0.7
    first = trajectory.transitions[0].decision
    assert first.candidates == ((first.action.text, 0.6), (MENU["ADD"] if menu else "ADD()", 0.4))
    # Chains are private to a step: later prompts hold the action alone.
    assert "number 1" not in "".join(m.text for m in requests[6 if menu else 1].messages)


def test_every_chain_is_followed_by_its_own_choice() -> None:
    _, requests = play(unsteady, {"reasoning": "self_consistency"}, menu=True)
    choices = requests[1:6]
    assert [r.tag.purpose for r in choices] == ["act"] * 5
    for i, request in enumerate(choices):
        text = "".join(m.text for m in request.messages)
        assert [f"number {j}" in text for j in range(5)] == [j == i for j in range(5)]


def test_credit_goes_to_the_returned_answer_or_to_the_majority() -> None:
    trajectory, _ = play(unsteady, {"reasoning": "self_consistency"}, steps=1)
    # ADD, SUB?, ...: with one step left nothing is right and all five say ADD; the first is returned.
    assert [c.credit for c in trajectory.calls[0].completions] == ["executed", *["explored"] * 4]
    spec = {"name": "self_consistency", "credit": "majority"}
    trajectory, _ = play(unsteady, {"reasoning": spec})
    # Right: SUB in samples 1, 3, 4.
    assert [c.credit for c in trajectory.calls[0].completions] == [
        "explored", "executed", "explored", "executed", "executed",
    ]  # fmt: skip
    trajectory, _ = play(unsteady, {"reasoning": "self_consistency"}, menu=True)
    assert credits_of(trajectory, "act")[:5] == ["explored", "executed", "explored", "explored", "explored"]
    assert credits_of(trajectory, "think")[:5] == ["explored", "executed", "explored", "explored", "explored"]


def test_nothing_legal_is_flagged() -> None:
    trajectory, _ = play(lambda r: "what?", {"reasoning": "self_consistency"})
    decision = trajectory.transitions[0].decision
    assert not decision.valid and "what?" in decision.action.message and decision.trace["dropped"] == 5
    assert trajectory.metrics["fallbacks"] == trajectory.metrics["invalid_actions"] == 3


def test_greedy_sampling_is_refused() -> None:
    with pytest.raises(SpecError, match="must be above 0"):
        play(unsteady, {"reasoning": {"name": "self_consistency", "sampling_temperature": 0}})
