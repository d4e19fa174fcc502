"""No text makes the world raise, and no play breaks its invariants."""

from __future__ import annotations

import random
import warnings

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agentspec.envs.deliverybench.world.engine import Outcome, World
from tests.envs.deliverybench.fuzz import hostile_text, sensible_text
from tests.envs.deliverybench.helpers import ledger_holds, tiny, world


def check(w: World, text: str, outcome: Outcome, before: int) -> None:
    """What holds after every step."""
    state = w.state
    assert isinstance(outcome.ok, bool) or outcome.ended, text
    assert bool(outcome.code) == (outcome.ok is False) and outcome.message, text
    assert before <= state.tick <= w.shift_ticks and outcome.seconds == (state.tick - before) / 10.0, text
    assert ledger_holds(w), text
    assert 0.0 <= state.scooter.battery <= 100.0 and state.energy >= 0.0, text
    assert len(state.pool) == w.rules.pool_size and not set(state.pool) & set(state.orders), text
    assert state.calls <= (w.max_calls or 0), text
    if w.rules.name == "fair":
        assert state.energy <= 100.0, text
        held = [id(item) for order in state.orders.values() for item in order.items]
        packed = [id(item) for item in state.bag.items() if item.food is not None]
        hand = [id(item) for order in state.orders.values() for item in order.pending]
        # Every dish of an order is in exactly one place.
        assert sorted(packed + hand) == sorted(held), text
    assert all(-15.0 <= item.temp <= 70.0 for item in w.look().bag.items()), text


def play(steps: int, seed: int) -> None:
    rng = random.Random(seed)
    done = 0
    while done < steps:
        rules = rng.choice(["fair", "original"])
        w = World(tiny(), rules, rng.choice([None, 0, 1, 2]), rng.choice([0.2, 1.0, 2.0]), rng.choice([50, 500]))
        while not w.state.ended and done < steps:
            text = hostile_text(rng) if rng.random() < 0.4 else sensible_text(rng, tiny(), w.state)
            before = w.state.tick
            check(w, text, w.step(text), before)
            done += 1


@pytest.mark.filterwarnings("ignore::SyntaxWarning")
def test_fuzz() -> None:
    play(50_000, seed=1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::SyntaxWarning")
def test_fuzz_long() -> None:
    play(1_000_000, seed=2)


@settings(max_examples=300, deadline=None)
@given(st.text(max_size=200))
def test_any_text(text: str) -> None:
    w = world("fair")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for wrapped in (text, f"MOVE({text})", f'PLACE_FOOD_IN_BAG(bag_cmd="{text}")', f"BUY(items=[{text}])"):
            assert w.step(wrapped).message
    assert ledger_holds(w)


def test_long_and_deep_texts() -> None:
    w = world("fair")
    for text in (
        "x" * 1_000_000,
        "MOVE(" + "[" * 5000,
        "MOVE(" + "-" * 3000 + "1, 1)",
        "{" * 4000,
        "\n" * 5000,
        "ß" * 4001,
    ):
        assert w.step(text).ok is False
