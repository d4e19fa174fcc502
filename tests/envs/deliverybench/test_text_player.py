"""Prompts carry what is needed: a player that reads nothing but their text earns well, through several methods."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.envs.deliverybench.helpers import REFERENCE
from tests.envs.deliverybench.text_player import answer, scene, seconds

METHODS = ("direct", "react", "plan_and_solve")
SHARE = 0.5
"""Of what the rule-based courier earns, who sees the state itself and has the city's map."""

CITIES = tuple(f"{size}-city-{n}" for size, ns in (
    ("small", (11, 13, 15)), ("medium", (18, 20, 22)), ("large", (26, 28, 30, 35)),
) for n in ns)  # fmt: skip
needs_cities = pytest.mark.skipif(
    not (REFERENCE / "maps").is_dir(), reason="the original cities are not beside the repository (folder shared)"
)


def played(reasoning: str, where: dict[str, Any], seed: int, **spec: Any) -> Trajectory:
    """An hour of a courier with these modules; by default each prompt holds one observation."""
    agent = AgentSpec.from_data({"reasoning": reasoning, "memory": "base", "layout": "snapshot", **spec})
    (trajectory,) = Runner(agent, ScriptedLLM(answer)).run([Job(Task("deliverybench", seed, {**where}))])
    assert not trajectory.error, trajectory.error
    return trajectory


@lru_cache(maxsize=64)
def ceiling(where: tuple[tuple[str, Any], ...], seed: int) -> float:
    """What the rule-based courier earns there."""
    return float(played("rule_based", dict(where), seed, memory="none").metrics["net_earnings"])


def earns_its_share(reasoning: str, where: dict[str, Any], seed: int) -> None:
    trajectory = played(reasoning, where, seed)
    earned, most = trajectory.metrics["net_earnings"], ceiling(tuple(where.items()), seed)
    assert most > 0 and earned >= SHARE * most, f"{reasoning} in {where}: {earned:.1f} $ of {most:.1f} $"
    # Every answer was read, and next to nothing of what the prompt suggested was refused.
    assert all(step.decision.valid for step in trajectory.transitions)
    refused = [step.info["error"] for step in trajectory.transitions if step.info.get("error")]
    assert len(refused) <= 0.02 * len(trajectory.transitions), refused


@pytest.mark.parametrize("method", METHODS)
def test_who_only_reads_the_prompt_earns_half_of_what_the_expert_does(method: str) -> None:
    earns_its_share(method, {"size": "small", "city_seed": 1}, seed=4)


@needs_cities
@pytest.mark.parametrize("city", ["small-city-11", "large-city-28"])
@pytest.mark.parametrize("method", METHODS)
def test_so_it_does_in_original_cities(method: str, city: str) -> None:
    earns_its_share(method, {"map": str(REFERENCE / "maps" / city)}, seed=1)


@needs_cities
@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4, 5, 11])
@pytest.mark.parametrize("city", CITIES)
@pytest.mark.parametrize("method", METHODS)
def test_so_it_does_in_every_original_city(method: str, city: str, seed: int) -> None:
    earns_its_share(method, {"map": str(REFERENCE / "maps" / city)}, seed=seed)


def test_the_player_reads_and_does_not_remember() -> None:
    """Its answer depends on the words of the prompt alone, wherever they come from."""
    text = (
        "00:10:00 on the clock, 50 min left. You are at restaurant 2 (10.0m, -20.5m), in the rented car (12 m/s, pace "
        "normal). Energy 80 %. Balance $90.00 (earned -10.00). Scooter battery 40 % (1000m), parked at (0.0m, 0.0m). "
        "Car rented for 10 min. You carry 2 energy_drink.\n\nYour orders:\n- order 3: ready in 1 min 5 s, 40 s late, "
        "pays $7.25. Pick-up restaurant 2 (10.0m, -20.5m) 1st road (left) (here), from there 300m to the drop-off "
        "building 4 (310.0m, -20.5m) 2nd road (right) (300m). Pizza 60C.\n\nAround you:\n- nearest: store 1 (5.0m, "
        "6.0m) 31m; car_rental 1 (10.0m, -20.0m) here\n"
    )
    seen = scene(text)
    (order,) = seen.orders
    assert (order.id, order.pay, order.left, order.ready, order.carried) == (3, 7.25, -40.0, 65.0, False)
    assert order.pickup == (10.0, -20.5) and order.dropoff == (310.0, -20.5)
    assert (seen.left, seen.position, seen.car, seen.goods) == (3000.0, (10.0, -20.5), True, {"energy_drink": 2})
    assert seen.nearest == {"store": ((5.0, 6.0), 31.0), "car_rental": ((10.0, -20.0), 0.0)}
    assert seen.offers is None and seconds("1 h 20 min") == 4800.0
    with pytest.raises(AssertionError, match="the prompt does not say"):
        scene(text.replace("Balance", "Purse"))
