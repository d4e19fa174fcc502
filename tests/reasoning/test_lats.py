"""LATS: the real environment is tried and left as it was; reflections only after failures; budgets; both worlds."""

from __future__ import annotations

import asyncio
import re

import pytest

from agentspec.episode import make_env
from agentspec.llm.base import LLMError, Request
from agentspec.llm.recorder import Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import SpecError
from agentspec.simulator import simulator_of
from agentspec.spec import AgentSpec
from agentspec.trajectory import replay
from agentspec.types import Task
from tests.reasoning.numbers_env import NUMBERS, ONE_WAY, NumbersEnv
from tests.reasoning.player import OPERATIONS, credits_of, last, named, play, purposes, seen, solved
from tests.reasoning.test_rap import imaginer

THOUGHT = "Smaller numbers double better."


def climber(request: Request):
    """Proposes everything; rates a state by how near it is to the target, which misleads."""
    if request.tag.purpose == "propose":
        names = [named(name, request) for name in OPERATIONS]
        if len(request.messages) > 2 and request.messages[-2].text == THOUGHT:
            return names[request.id % len(names)]  # a choice after a thought is asked for alone
        return (names * request.sampling.n)[: request.sampling.n]
    if request.tag.purpose == "think":
        return THOUGHT
    number, target, _ = seen(last(request))
    if request.tag.purpose == "reflect":
        return f"Ending at {number} was wrong."
    if request.tag.purpose == "world":
        return imaginer(request)
    return str(max(1, 10 - abs(number - target)))


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("menu", [False, True])
def test_solves_what_direct_does_not(menu: bool, layout: str) -> None:
    trajectory, _ = play(climber, {"reasoning": "lats", "layout": layout}, menu=menu)
    assert solved(trajectory)
    trace = trajectory.transitions[0].decision.trace
    assert trace["world"] == "environment" and trace["solved"]
    credits = credits_of(trajectory, "propose")
    assert credits.count("executed") == len(trajectory.transitions)
    assert set(credits_of(trajectory, "value")) == {"aux"} == set(credits_of(trajectory, "reflect"))


class Inline:
    """Runs an environment's calls at once."""

    async def call(self, what, function):
        return function()


@pytest.mark.parametrize("limits", [{}, {"max_calls": 3}, {"preset": "rl"}, {"preset": "rl", "max_calls": 7}])
def test_the_environment_is_left_as_it_was(limits: dict) -> None:
    task = Task(NUMBERS, 0, {"steps": 4})
    env = NumbersEnv(steps=4)
    observation, info = env.reset(seed=0)
    agent = AgentSpec.from_data({"reasoning": {"name": "lats", **limits}}).build(
        Recorder(ScriptedLLM(climber), episode="e", seed=0)
    )
    agent.attach_simulator(simulator_of(env, Inline(), task, agent.perception))
    agent.begin_episode(task)
    before = env.snapshot()
    _, decision = asyncio.run(agent.decide(task, observation, info))
    assert env.snapshot() == before and decision.trace["world"] == "environment"


def test_it_is_put_back_when_the_model_fails() -> None:
    def fails(request: Request):
        if request.tag.purpose == "value":
            raise LLMError("no answer")
        return climber(request)

    task, env = Task(NUMBERS, 0), NumbersEnv()
    observation, info = env.reset(seed=0)
    agent = AgentSpec.from_data({"reasoning": "lats"}).build(Recorder(ScriptedLLM(fails), episode="e", seed=0))
    agent.attach_simulator(simulator_of(env, Inline(), task, agent.perception))
    agent.begin_episode(task)
    before = env.snapshot()
    with pytest.raises(LLMError):
        asyncio.run(agent.decide(task, observation, info))
    assert env.snapshot() == before


@pytest.mark.parametrize("preset", ["paper", "rl"])
def test_an_episode_is_what_its_executed_actions_make_it(preset: str) -> None:
    spec = {"name": "lats", "preset": preset}
    trajectory, _ = play(climber, {"reasoning": spec}, steps=4)
    assert replay(trajectory, make_env) == []


def test_visits_are_conserved() -> None:
    spec = {"name": "lats", "num_iterations": 6, "rollout": "value"}
    trajectory, _ = play(climber, {"reasoning": spec}, target=1000, steps=9)
    for t in trajectory.transitions[:2]:
        trace = t.decision.trace
        assert trace["iterations"] == 6 == sum(trace["visits"])


def test_reflections_come_after_failures_only_and_are_capped() -> None:
    spec = {"name": "lats", "max_reflections": 2, "rollout": "value"}
    _, requests = play(climber, {"reasoning": spec}, target=1000, steps=2)
    assert "reflect" in purposes(requests)
    learnt: list[str] = []
    for request in requests:
        shown = re.findall(r"- (Ending at -?\d+ was wrong\.)", last(request))
        assert len(shown) <= 2
        if request.tag.purpose in ("propose", "value"):
            assert shown == learnt[-2:]
        if request.tag.purpose == "reflect":
            learnt.append(f"Ending at {seen(last(request))[0]} was wrong.")
    # No failure, no reflection: from 7 ADD is the first thing tried and succeeds.
    _, requests = play(climber, {"reasoning": "lats"}, number=7, target=10)
    assert "reflect" not in purposes(requests)


def test_a_success_ends_the_search() -> None:
    trajectory, requests = play(climber, {"reasoning": "lats"}, number=7, target=10)
    # One expansion; of its children only those that are no end are rated: DOUBLE (14) and SUB (6).
    assert purposes(requests) == ["propose", "value", "value"]
    assert trajectory.transitions[0].decision.trace["iterations"] == 1 and solved(trajectory)


def test_the_root_gets_more_samples_and_equal_ones_are_merged() -> None:
    trajectory, requests = play(climber, {"reasoning": "lats"})
    assert requests[0].sampling.n == 10 and {r.sampling.n for r in requests[1:] if r.tag.purpose == "propose"} <= {
        5,
        10,
    }
    assert len(trajectory.transitions[0].decision.candidates) == 3


def test_a_budget_returns_the_best_so_far_flagged() -> None:
    trajectory, _ = play(climber, {"reasoning": {"name": "lats", "max_calls": 3}})
    decision = trajectory.transitions[0].decision
    # 1 proposal and 2 of 3 ratings; no iteration came to its end. ADD: 0.5 * 9/10 + 0.5 * share(4 of 10) = 0.65.
    assert decision.trace["calls"] == 3 and decision.trace["exhausted"] == "calls" and decision.valid
    assert decision.action.name == "ADD" and dict(decision.candidates)["ADD()"] == pytest.approx(0.65)


def test_the_episodes_budget_flags_too() -> None:
    trajectory, _ = play(climber, {"reasoning": "lats", "budget": {"calls": 3}})
    assert trajectory.transitions[0].decision.trace["exhausted"] == "episode"
    # Then not even a proposal is affordable: the episode ends in an orderly way.
    assert trajectory.metrics["ended"] == "budget" and trajectory.status == "completed"


def test_without_snapshots_it_is_refused_or_imagines_and_says_so() -> None:
    with pytest.raises(SpecError, match=r"snapshots.*set `world: model`"):
        play(climber, {"reasoning": "lats"}, env=ONE_WAY)
    trajectory, _ = play(climber, {"reasoning": {"name": "lats", "world": "model"}}, env=ONE_WAY)
    assert solved(trajectory)
    assert {t.decision.trace["world"] for t in trajectory.transitions} == {"model"}


def test_the_model_world_can_be_chosen_where_snapshots_exist() -> None:
    trajectory, requests = play(climber, {"reasoning": {"name": "lats", "world": "model"}}, env=NUMBERS, menu=True)
    assert "world" in purposes(requests)
    assert trajectory.transitions[0].decision.trace["world"] == "model"


def test_with_a_menu_thoughts_are_part_of_the_nodes() -> None:
    """A thought is asked for before the choice, stands in the course under judgement, and is credited with it."""

    trajectory, requests = play(
        climber, {"reasoning": {"name": "lats", "preset": "rl", "num_iterations": 9, "think": True}}, menu=True
    )
    assert solved(trajectory)
    decision = trajectory.transitions[0].decision
    assert decision.rationale == THOUGHT
    assert len(decision.calls) == 2 and credits_of(trajectory, "think").count("executed") == len(trajectory.transitions)
    chosen = next(r for r in requests if r.tag.purpose == "propose")
    assert chosen.sampling.choices and chosen.messages[-2].text == THOUGHT
    judged = next(r for r in requests if r.tag.purpose == "value")
    assert f"(thought: {THOUGHT})" in judged.messages[-1].text


def test_the_small_preset_chooses_from_a_menu_at_once() -> None:
    _, requests = play(climber, {"reasoning": {"name": "lats", "preset": "rl"}}, menu=True, steps=1)
    assert "think" not in {r.tag.purpose for r in requests}
