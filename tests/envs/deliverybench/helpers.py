"""What the simulator's tests share: a tiny city, and a courier put where a test needs him."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import pytest

from agentspec.envs.deliverybench.city.citymap import City
from agentspec.envs.deliverybench.city.generate import generate
from agentspec.envs.deliverybench.world.engine import Outcome, World
from agentspec.envs.deliverybench.world.orders import Point
from agentspec.envs.deliverybench.world.rules import Rules

REFERENCE = Path(__file__).resolve().parents[3] / ".." / "shared" / "deliverybench"
needs_reference = pytest.mark.skipif(
    not (REFERENCE / "traces").is_dir(), reason="the reference episodes are not beside the repository (folder shared)"
)


@lru_cache(maxsize=1)
def tiny() -> City:
    """A city of a few roads."""
    return generate("tiny", 0)


def world(rules: Rules | str = "original", seed: int | None = 0, hours: float = 2.0, calls: int = 1000) -> World:
    """A fresh world in the tiny city."""
    return World(tiny(), rules, seed, hours, calls)


def stand(w: World, kind: str) -> Point:
    """Put the courier at the first place of a kind; returns where."""
    w.state.position = tiny().pois_of(kind)[0].anchor
    return w.state.position


def do(w: World, text: str) -> Outcome:
    """A step that must succeed."""
    outcome = w.step(text)
    assert outcome.ok, (text, outcome.code, outcome.message)
    return outcome


def refuse(w: World, text: str, code: str) -> Outcome:
    """A step that must fail with ``code`` and a message."""
    outcome = w.step(text)
    assert outcome.ok is False and outcome.code == code and outcome.message, (text, outcome)
    return outcome


def collect(w: World, *numbers: int) -> None:
    """Accept orders, let them get ready, and pick each up at its restaurant."""
    do(w, f"ACCEPT_ORDER({list(numbers)})")
    do(w, "WAIT(420)")
    for number in numbers:
        w.state.position = w.state.orders[number].offer.pickup.anchor
        if w.state.orders[number].picked is None:
            do(w, f"PICKUP(orders=[{number}])")


def metres(point: Point) -> str:
    """A point as MOVE arguments."""
    return f"{point[0] / 100:.2f}m, {point[1] / 100:.2f}m"


def off(point: Point, dx: float, dy: float = 0.0) -> Point:
    """A point beside another (cm)."""
    return (point[0] + dx, point[1] + dy)


def ledger_holds(w: World) -> bool:
    """Balance = initial + income - expenses, and every number is finite."""
    state = w.state
    numbers = (state.balance, state.energy, state.scooter.battery, state.yaw, *state.position)
    total = w.rules.initial_balance + sum(state.ledger.values())
    return all(map(math.isfinite, numbers)) and math.isclose(total, state.balance, abs_tol=1e-6)
