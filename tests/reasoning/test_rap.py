"""RAP in an episode: rewards from scores and the goal, presets, budgets; it solves what greed does not."""

from __future__ import annotations

import math
import re

import pytest

from agentspec.llm.base import Request
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from tests.reasoning.player import (
    OPERATIONS,
    credits_of,
    last,
    named,
    operations,
    play,
    purposes,
    seen,
    solved,
)

LARGE = {"name": "rap", "num_iterations": 100, "depth": 3, "exploration": 5.0}


def imaginer(request: Request):
    """Proposes everything, and predicts by the rules."""
    number, target, left = seen(last(request))
    if request.tag.purpose == "propose":
        names = [named(name, request) for name in OPERATIONS]
        return (names * request.sampling.n)[: request.sampling.n]
    if request.tag.purpose == "judge":
        return "good"
    (name,) = operations(last(request).rsplit("\n\n", 1)[0].splitlines()[-1])
    number, left = OPERATIONS[name](number), left - 1
    goal = "yes" if number == target else "no" if left > 0 else "over"
    return f"The number is {number}. The target is {target}. There are {left} steps left.\nGoal: {goal}"


def nearness(messages, continuation: str) -> float:
    """log p: every action equally likely; "good" the likelier the nearer the action comes at once (misleading)."""
    if continuation != "good":
        return -1.0
    (name,) = operations(re.findall(r"would be: (.*)", messages[-1].text)[-1])
    number, target, _ = seen(messages[-1].text)
    return -abs(OPERATIONS[name](number) - target) / 10


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("menu", [False, True])
@pytest.mark.parametrize("evaluation", ["score", "samples"])
def test_solves_what_direct_does_not(evaluation: str, menu: bool, layout: str) -> None:
    spec = {"reasoning": {**LARGE, "evaluation": evaluation}, "layout": layout}
    trajectory, requests = play(imaginer, spec, score=nearness, menu=menu)
    assert solved(trajectory)
    assert trajectory.transitions[0].decision.trace["world"] == "model"
    credits = credits_of(trajectory, "propose")
    assert credits.count("executed") == len(trajectory.transitions)
    assert set(credits_of(trajectory, "world")) == {"aux"}
    assert ("judge" in purposes(requests)) == (evaluation == "samples")


def test_rewards_are_those_of_the_paper() -> None:
    # Depth 1, no exploration: each of the three actions, if visited, is a leaf. The model says DOUBLE is nearest.
    # fast = 0.5 * (log p(action) + log p(good)) = 0.5 * (-1 - 1 / 10) = -0.55 for 3 -> 6, which is 1 away from 7.
    spec = {"name": "rap", "num_iterations": 1, "depth": 1}
    trajectory, _ = play(imaginer, {"reasoning": spec}, score=nearness)
    values = dict(trajectory.transitions[0].decision.candidates)
    assert values["ADD()"] == pytest.approx(-0.55)
    assert values["SUB()"] == pytest.approx(0.5 * (-1 - 0.5))  # 3 -> 2, 5 away
    # At 5 of 10 DOUBLE reaches the goal: 0.5 * (-1 - 0) + 0.5 * 100 = 49.5, whatever its judgement.
    trajectory, _ = play(imaginer, {"reasoning": spec}, score=nearness, number=5, target=10)
    assert dict(trajectory.transitions[0].decision.candidates)["DOUBLE()"] == pytest.approx(49.5)
    assert trajectory.transitions[0].decision.action.name == "DOUBLE"


def test_a_goal_beats_any_judgement() -> None:
    def prefers_add(messages, continuation: str) -> float:
        return 0.0 if "ADD" in messages[-1].text.rsplit("would be:", 1)[-1] or continuation == "ADD()" else -4.0

    trajectory, _ = play(
        imaginer, {"reasoning": {**LARGE, "depth": 1, "num_iterations": 12}}, score=prefers_add, number=5, target=10
    )
    assert trajectory.transitions[0].decision.action.name == "DOUBLE"


def test_counting_samples_stands_in_for_scores() -> None:
    def script(request: Request):
        if request.tag.purpose == "propose":
            return ["ADD()", "ADD()", "SUB()"]
        return ["good", "bad", "good"] if request.tag.purpose == "judge" else "Goal: no"

    spec = {"name": "rap", "evaluation": "samples", "num_iterations": 1, "depth": 1, "num_actions": 3}
    trajectory, _ = play(script, {"reasoning": spec})
    values = dict(trajectory.transitions[0].decision.candidates)
    # 2 of 3 samples propose ADD; 2 of 3 say good, smoothed (2+1)/(3+2).
    assert values["ADD()"] == pytest.approx(0.5 * (math.log(2 / 3) + math.log(3 / 5)))
    assert values["SUB()"] == pytest.approx(0.5 * (math.log(1 / 3) + math.log(3 / 5)))


def test_without_scores_it_is_refused_or_counts_samples() -> None:
    offers = frozenset({"n", "choices"})
    with pytest.raises(SpecError, match=r"needs score.*set `evaluation: samples`"):
        AgentSpec.from_data({"reasoning": "rap"}).check(offers, "backend x")
    AgentSpec.from_data({"reasoning": {"name": "rap", "evaluation": "samples"}}).check(offers, "backend x")


def test_a_budget_returns_the_best_so_far_flagged() -> None:
    # Requests and scorings: 1 proposal, then 1 + 3 scorings; the world model may not be asked any more.
    spec = {"name": "rap", "preset": "rl", "reward": "paper", "max_calls": 5}
    trajectory, requests = play(imaginer, {"reasoning": spec}, score=nearness)
    decision = trajectory.transitions[0].decision
    assert purposes(requests) == ["propose"] * len(trajectory.transitions)
    assert decision.trace["exhausted"] == "calls" and decision.valid and decision.action.name == "ADD"


@pytest.mark.parametrize("output", ["max_reward", "max_visits", "max_iter"])
def test_every_output_finds_the_way(output: str) -> None:
    # The goal's reward draws the visits too, if there are enough of them.
    spec = {**LARGE, "num_iterations": 100, "output": output}
    trajectory, _ = play(imaginer, {"reasoning": spec}, score=nearness)
    assert solved(trajectory)
