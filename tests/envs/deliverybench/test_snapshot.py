"""Snapshots: restoring one is as if nothing had happened since."""

from __future__ import annotations

import json
import random

import pytest

from agentspec.envs.deliverybench.world.engine import World
from tests.envs.deliverybench.fuzz import hostile_text, sensible_text
from tests.envs.deliverybench.helpers import collect, do, tiny, world


def wander(w: World, rng: random.Random, steps: int) -> list[object]:
    """Random play; what came out of it."""
    outcomes = []
    for _ in range(steps):
        text = hostile_text(rng) if rng.random() < 0.1 else sensible_text(rng, tiny(), w.state)
        outcome = w.step(text)
        outcomes.append((outcome.ok, outcome.code, outcome.message, outcome.seconds, outcome.ended))
    return outcomes


@pytest.mark.parametrize("rules", ["original", "fair"])
@pytest.mark.parametrize("seed", range(12))
def test_random_play_goes_on_identically(rules: str, seed: int) -> None:
    rng = random.Random(seed)
    w = world(rules, seed=seed)
    wander(w, rng, 60)
    blob = w.snapshot()
    first = wander(w, random.Random(seed + 100), 60)
    after = w.snapshot()
    # Back in the same world, and in a fresh one.
    for other in (w, world(rules, seed=seed)):
        other.restore(blob)
        assert other.snapshot() == blob
        assert wander(other, random.Random(seed + 100), 60) == first
        assert other.snapshot() == after
        assert other.summary() == w.summary()


def test_snapshot_does_not_disturb() -> None:
    one, two = world("fair"), world("fair")
    rng, gnr = random.Random(3), random.Random(3)
    for _ in range(80):
        one.snapshot()
        assert wander(one, rng, 1) == wander(two, gnr, 1)
    assert one.snapshot() == two.snapshot()


def test_shared_and_detached_food_survive() -> None:
    w = world("original")
    collect(w, 0, 1)
    do(w, 'PLACE_FOOD_IN_BAG(bag_cmd="order 0: 1 -> A")')
    do(w, 'PLACE_FOOD_IN_BAG(bag_cmd="order 1: 1 -> A")')
    w.restore(w.snapshot())
    bagged = list(w.state.bag.items())
    # The original freezes the first order's food: the bag holds a copy. The second order's is the very item.
    assert w.state.orders[0].items[0] not in bagged
    assert w.state.orders[1].items[0] in bagged


def test_foreign_bytes_are_refused() -> None:
    w = world("fair")
    before = w.snapshot()
    other = json.loads(before)
    other["version"] = 99
    for blob in (b"", b"\x80\x04K\x01.", b"[]", b"{}", json.dumps(other).encode(), world("original").snapshot()):
        with pytest.raises(ValueError, match="not a snapshot"):
            w.restore(blob)
    assert w.snapshot() == before


def test_snapshots_are_small() -> None:
    w = world("fair", calls=10_000)
    wander(w, random.Random(0), 300)
    assert len(w.snapshot()) < 40_000
