"""Tree of Thoughts: layers and requests, pruning, backtracking, both modes; it solves what greed does not."""

from __future__ import annotations

import re

import pytest

from agentspec.llm.base import Request
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from tests.reasoning.numbers_env import MENU
from tests.reasoning.player import (
    OPERATIONS,
    credits_of,
    greedy_player,
    last,
    named,
    operations,
    play,
    purposes,
    seen,
    solve,
    solved,
)


def course_of(text: str) -> list[str]:
    return operations("\n".join(re.findall(r"^\d+\. .*$", text, re.MULTILINE)))


def thinker(request: Request):
    """Proposes everything; judges a course by playing the rest of it out."""
    number, target, left = seen(last(request))
    if request.tag.purpose == "propose":
        if request.sampling.n > 1:
            return [named(name, request) for name in OPERATIONS][: request.sampling.n]
        return "\n".join(f"{i}. {name}()" for i, name in enumerate(OPERATIONS, 1))
    for name in course_of(last(request).split("course of action under")[-1]):
        if number == target:
            break
        number, left = OPERATIONS[name](number), left - 1
    possible = number == target or (left > 0 and solve(number, target, left) is not None)
    return "sure" if possible else "impossible"


def test_layers_and_requests_of_the_paper() -> None:
    # k=3, b=2, T=3: layers 3, 2x3, 2x3; proposals 1+2+2 = 5; judgements 3+6+6 = 15 requests of 3 samples.
    trajectory, requests = play(thinker, {"reasoning": "tot"}, steps=5)
    first = [r for r in requests if r.tag.step == 0]
    assert trajectory.transitions[0].decision.trace["layers"] == [3, 6, 6]
    assert purposes(first).count("propose") == 5 and purposes(first).count("value") == 15
    assert {r.sampling.n for r in first if r.tag.purpose == "value"} == {3}
    assert first[0].tag.purpose == "propose" and purposes(first)[1:4] == ["value"] * 3


def test_the_best_of_a_layer_are_kept() -> None:
    # Of ADD, DOUBLE, SUB the values are 1, 20, 0.001 (one evaluation): DOUBLE and ADD go on, SUB is pruned.
    values = {"ADD": "likely", "DOUBLE": "sure", "SUB": "impossible"}

    def script(request: Request) -> str:
        if request.tag.purpose == "propose":
            return "ADD()\nDOUBLE()\nSUB()"
        return f"hm, {values[course_of(last(request))[0]]}."

    trajectory, requests = play(script, {"reasoning": {"name": "tot", "evaluations": 1, "depth": 2}})
    proposals = [r for r in requests if r.tag.step == 0 and r.tag.purpose == "propose"]
    assert [course_of(last(r)) for r in proposals] == [[], ["DOUBLE"], ["ADD"]]
    decision = trajectory.transitions[0].decision
    assert decision.action.name == "DOUBLE"
    assert decision.candidates == (("ADD()", 1.0), ("DOUBLE()", 20.0), ("SUB()", 0.001))


def test_values_add_up_and_repeated_candidates_count_nothing() -> None:
    def script(request: Request):
        if request.tag.purpose == "propose":
            return "ADD()\nadd()\nDOUBLE()"
        return ["sure", "likely", "who knows"] if "ADD" in last(request) else "impossible"

    trajectory, _ = play(script, {"reasoning": "tot"})
    decision = trajectory.transitions[0].decision
    assert decision.candidates == (("ADD()", 21.0), ("DOUBLE()", 0.003))  # add() is ADD() written otherwise
    assert decision.trace["unread_judgements"] > 0


def test_depth_first_goes_in_order_of_value_prunes_and_backtracks() -> None:
    # Looks best at first, but after DOUBLE everything is impossible: back to ADD.
    def script(request: Request) -> str:
        if request.tag.purpose == "propose":
            return "ADD()\nDOUBLE()\nSUB()"
        course = course_of(last(request))
        if len(course) == 1:
            return {"ADD": "likely", "DOUBLE": "sure", "SUB": "impossible"}[course[0]]
        return "impossible" if course[0] == "DOUBLE" else "sure"

    spec = {"name": "tot", "search_strategy": "DFS", "depth": 2, "breadth": 1, "evaluations": 1}
    trajectory, requests = play(script, {"reasoning": spec})
    proposals = [r for r in requests if r.tag.step == 0 and r.tag.purpose == "propose"]
    assert [course_of(last(r)) for r in proposals] == [[], ["DOUBLE"], ["ADD"]]
    assert trajectory.transitions[0].decision.action.name == "ADD"


def test_votes_decide_among_all_candidates() -> None:
    def script(request: Request):
        if request.tag.purpose == "propose":
            return ["ADD()", "SUB()", "ADD()"]
        assert "1. ADD()" in last(request) or "; then" in last(request)
        return ["best is 2", "2", "1"]

    spec = {"name": "tot", "evaluation_strategy": "vote", "generation": "sample", "breadth": 1, "depth": 2}
    trajectory, requests = play(script, {"reasoning": spec})
    assert trajectory.transitions[0].decision.candidates == (("ADD()", 1.0), ("SUB()", 2.0))
    assert trajectory.transitions[0].decision.action.name == "SUB"
    assert purposes(requests)[:4] == ["propose", "vote", "propose", "vote"]


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("menu", [False, True])
@pytest.mark.parametrize("strategy", ["BFS", "DFS"])
def test_solves_what_direct_does_not(strategy: str, menu: bool, layout: str) -> None:
    assert not solved(play(greedy_player, {"reasoning": "direct", "layout": layout}, menu=menu)[0])
    spec = {"reasoning": {"name": "tot", "search_strategy": strategy}, "layout": layout}
    trajectory, requests = play(thinker, spec, menu=menu)
    assert solved(trajectory)
    assert trajectory.metrics["invalid_actions"] == 0
    # One proposal per step is executed; the others were explored, judges only helped.
    credits = credits_of(trajectory, "propose")
    assert credits.count("executed") == len(trajectory.transitions) and set(credits) == {"executed", "explored"}
    assert set(credits_of(trajectory, "value")) == {"aux"}
    if menu:
        assert requests[0].sampling.choices == tuple(MENU.values())


def test_a_budget_returns_the_best_so_far_flagged() -> None:
    # 1 proposal and 2 of 3 judgements: ADD impossible, DOUBLE impossible; the first of equals.
    spec = {"name": "tot", "max_calls": 3, "evaluations": 1}
    trajectory, requests = play(thinker, {"reasoning": spec})
    decision = trajectory.transitions[0].decision
    assert purposes(requests)[:3] == ["propose", "value", "value"] and decision.trace["calls"] == 3
    assert decision.trace["exhausted"] == "calls" and decision.valid and decision.action.name == "ADD"
    assert trajectory.metrics["exhausted_searches"] == len(trajectory.transitions)


def test_one_level_is_refused() -> None:
    with pytest.raises(SpecError, match="depth must be at least 2"):
        play(thinker, {"reasoning": {"name": "tot", "depth": 1}})
    with pytest.raises(SpecError, match="no preset 'cheap'"):
        play(thinker, {"reasoning": {"name": "tot", "preset": "cheap"}})
    assert AgentSpec.from_data({"reasoning": {"name": "tot", "preset": "rl"}}).needs() == {"n"}
