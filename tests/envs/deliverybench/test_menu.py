"""The menu: few, distinct, stable and legal options, each one native call."""

from __future__ import annotations

import random

import pytest

from agentspec.envs.deliverybench.city.generate import generate
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.cards import OfferCards, describe
from agentspec.envs.deliverybench.view.menu import MAX_CHOICES, MAX_ORDERS, best_offers, options
from agentspec.envs.deliverybench.world.engine import World


def texts(world: World) -> list[str]:
    return [option.text for option in options(describe(world, OfferCards(world.book)))]


def take(world: World, text: str) -> None:
    view = describe(world, OfferCards(world.book))
    call = next(option.call for option in options(view) if option.text == text)
    assert world.step(call).ok, (text, call)


def test_one_order_from_offer_to_delivery() -> None:
    world = World(generate("tiny", 0), seed=0)
    first = texts(world)
    assert [t.startswith("accept order") for t in first] == [True, True, True, False] and first[-1] == "wait 1 minute"
    number = int(first[0].split()[-1])
    take(world, first[0])
    take(world, f"go to pickup of order {number}")
    if f"wait for order {number}" in texts(world):
        take(world, f"wait for order {number}")
    take(world, f"pick up order {number}")
    # With food in the hand it is packed before the courier rides on.
    assert f"go to drop-off of order {number}" not in texts(world)
    take(world, f"bag order {number}")
    take(world, f"go to drop-off of order {number}")
    (delivery,) = [t for t in texts(world) if t.startswith(f"deliver order {number}")]
    take(world, delivery)
    assert len(world.state.settlements) == 1 and world.state.settlements[0].method_star == 5


def test_best_offers_pay_most_for_their_way() -> None:
    world = World(generate("small", 0), seed=0)
    view = describe(world, OfferCards(world.book))
    shown = best_offers(view, 10)
    rates = [(o["pay"] + 2.0) / (o["to_pickup_m"] + o["distance_m"] + 100.0) for o in shown]
    assert rates == sorted(rates, reverse=True)
    # With half a minute left nothing can be cooked, fetched and delivered.
    assert best_offers({**view, "left_s": 30.0}) == []


def test_orders_are_limited_and_the_menu_with_them() -> None:
    world = World(generate("tiny", 0), seed=0)
    for _ in range(MAX_ORDERS):
        take(world, next(t for t in texts(world) if t.startswith("accept")))
    assert not any(t.startswith("accept") for t in texts(world))


def test_charging_and_rest_appear_when_needed() -> None:
    world = World(generate("tiny", 0), seed=0)
    assert "go to charger" not in texts(world)
    world.state.scooter.battery = 30.0
    world.state.energy = 30.0
    assert {"go to charger", "go to rest area"} <= set(texts(world))
    take(world, "go to charger")
    take(world, "charge to 80%")
    assert {"wait for charging", "ride scooter"} <= set(texts(world))
    take(world, "wait for charging")
    assert world.state.scooter.battery == pytest.approx(80.0) and "wait for charging" not in texts(world)
    take(world, "ride scooter")
    take(world, "go to rest area")
    take(world, "rest to 80%")
    assert world.state.energy == pytest.approx(80.0) and world.state.mode == "e-scooter"


def test_a_scooter_left_behind_can_be_fetched() -> None:
    world = World(generate("tiny", 0), seed=0)
    world.step('SWITCH(to="walk")')
    world.step("MOVE(0m, 40m)")
    take(world, "go to scooter")
    take(world, "ride scooter")


@pytest.mark.parametrize("seed", range(3))
def test_every_option_of_a_random_episode_is_sensible(seed: int) -> None:
    env = DeliveryBenchEnv(size="tiny", city_seed=seed, action_mode="menu", observation="compact", max_steps=40)
    _, info = env.reset(seed=seed)
    rng, ended = random.Random(seed), False
    while not ended:
        choices = info["action_schema"].choices
        assert 1 <= len(choices) <= MAX_CHOICES and len({c.casefold() for c in choices}) == len(choices)
        assert all(len(choice) <= 40 for choice in choices)
        # Each one succeeds from here, except that a way may be longer than battery or energy last.
        here = env.snapshot()
        for choice in choices:
            outcome = env.step(choice)[4]
            assert outcome["error_code"] in ("", "MV_DEPLETED", "MV_COLLAPSED"), (choice, outcome["error"])
            env.restore(here)
        _, _, terminated, truncated, info = env.step(rng.choice(choices))
        ended = terminated or truncated


def test_bag_command_keeps_hot_and_cold_apart_and_smelly_food_alone() -> None:
    bag = {label: {"air": 23.0, "items": []} for label in "ABCD"}
    order = {"id": 3, "hand": ["Burger", "Salad", "Fries", "Popsicle", "Durian"]}
    # Hot 60 with hot 60 into A, cold 5 into B, frozen -12 into C, smelly durian (23) into the empty D.
    assert calls.bag({"bag": bag}, [order]) == 'PLACE_FOOD_IN_BAG(bag_cmd="order 3: 1,3 -> A; 2 -> B; 4 -> C; 5 -> D")'


def test_food_in_the_hand_is_bagged_before_anything_moves() -> None:
    env = DeliveryBenchEnv(size="tiny", action_mode="menu")
    _, info = env.reset(seed=0)
    while not any(order["hand"] for order in info["state"]["orders"]):
        texts = info["action_schema"].choices
        wanted = [t for t in texts if t.startswith(("pick up", "wait for", "go to pickup"))]
        *_, info = env.step((wanted or texts)[0])
    choices = info["action_schema"].choices
    assert choices[0].startswith("bag order") and not any(c.startswith("go to") for c in choices)
    *_, info = env.step(choices[0])
    assert not info["invalid"] and any(c.startswith("go to drop-off") for c in info["action_schema"].choices)


def test_handover_follows_the_note() -> None:
    card = {"id": 1, "dropoff_xy": [1.0, 2.0], "handoff_xy": [5.0, 6.0], "note": ""}
    assert calls.handover(card) == ("leave_at_door", [1.0, 2.0])
    assert calls.handover({**card, "note": "The bell is broken, so knock."})[0] == "knock"
    hand = {**card, "note": "I am waiting outside and will take it from you."}
    assert calls.handover(hand) == ("hand_to_customer", [5.0, 6.0])
    assert calls.handover({**hand, "handoff_xy": None}) == ("leave_at_door", [1.0, 2.0])


def test_calls_are_written_as_the_grammar_wants_them() -> None:
    assert calls.move((1.0, -2.5)) == "MOVE(1.00m, -2.50m)"
    assert calls.move((1.0, -2.5), "accel") == 'MOVE(1.00m, -2.50m, pace="accel")'
    assert calls.wait(61.23) == "WAIT(61.3)" and calls.wait(60.0) == "WAIT(60)"
    assert calls.accept([1, 2]) == "ACCEPT_ORDER([1, 2])" and calls.pick_up([4]) == "PICKUP(orders=[4])"
    assert calls.prep_seconds(["Popsicle", "Sushi"]) == 420.0
