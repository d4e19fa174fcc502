"""The order pool: bit for bit as in the reference, and its own properties."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from agentspec.envs.deliverybench.city.citymap import load_city
from agentspec.envs.deliverybench.world.food import MENU
from agentspec.envs.deliverybench.world.notes import METHODS, NOTES
from agentspec.envs.deliverybench.world.orders import OrderBook, pick_scores
from agentspec.envs.deliverybench.world.rules import ORIGINAL
from tests.envs.deliverybench.helpers import REFERENCE, do, needs_reference, refuse, stand, tiny, world


@needs_reference
@pytest.mark.parametrize("path", sorted((REFERENCE / "traces").glob("*.json")), ids=lambda path: path.stem)
def test_reference_orders(path: Path) -> None:
    trace = json.loads(path.read_text())
    book = OrderBook(load_city(REFERENCE / "maps" / trace["map"]), ORIGINAL, trace["seed"])
    wanted = [*trace["initial_pool"], *(order for step in trace["steps"] for order in step["new_pool_orders"])]
    for order in wanted:
        offer = book[order["id"]]
        assert [food.name for food in offer.foods] == [item["name"] for item in order["items"]]
        assert [c / 100 for c in offer.pickup.anchor] == pytest.approx(order["pickup_xy"], abs=1e-5)
        assert [c / 100 for c in offer.dropoff.anchor] == pytest.approx(order["dropoff_xy"], abs=1e-5)
        figures = (offer.distance / 100, offer.pay, offer.limit, offer.pay_jitter, offer.time_jitter, offer.prep)
        names = ("distance_m", "earnings", "time_limit_s", "earning_mult", "time_mult", "prep_longest_s")
        assert figures == pytest.approx([order[name] for name in names], abs=2e-6)
        assert (list(offer.methods), bool(offer.note)) == (order["allowed_methods"], order["has_note"])
        if order["handoff_xy"] is None:
            assert offer.handoff is None
        else:
            assert offer.handoff is not None
            assert [c / 100 for c in offer.handoff] == pytest.approx(order["handoff_xy"], abs=1e-5)


@needs_reference
def test_reference_menu_and_notes() -> None:
    items = json.loads((REFERENCE / "food.json").read_text())["items"]
    rows = [(f.name, f.category, f.smells, f.fragile, f.prep, f.serving, f.capacity) for f in MENU]
    assert rows == [
        (
            item["name"], item["category"], item["odor"] == "strong", item["motion_sensitive"], item["prep_time_s"],
            item["serving_temp_c"], item["heat_capacity"],
        )
        for item in items
    ]  # fmt: skip
    methods = json.loads((REFERENCE / "note_methods.json").read_text())["methods"]
    assert [list(allowed) for _, allowed in NOTES] == methods


def test_offers_are_a_function_of_seed_and_number() -> None:
    first, second = OrderBook(tiny(), ORIGINAL, 5), OrderBook(tiny(), ORIGINAL, 5)
    assert second[7] == first[7] and first[7] is first[7]
    assert [first[n].foods for n in range(5)] == [second[n].foods for n in range(5)]
    assert OrderBook(tiny(), ORIGINAL, 6)[7] != first[7]
    assert OrderBook(tiny(), ORIGINAL, None)[0] == OrderBook(tiny(), ORIGINAL, None)[0]


def test_every_offer_is_sound() -> None:
    book = OrderBook(tiny(), ORIGINAL, 1)
    for number in range(300):
        offer = book[number]
        assert offer.pickup.kind == "restaurant" and offer.dropoff.kind == "building"
        assert 1 <= len(offer.foods) <= 4 and len(set(offer.foods)) == len(offer.foods)
        assert offer.limit >= offer.prep + 60.0 and offer.pay > 0.0
        assert set(offer.methods) <= set(METHODS) and bool(offer.note) == bool(offer.methods)
        assert (offer.handoff is not None) == ("hand_to_customer" in offer.methods)
        if offer.handoff is not None:
            assert 499.9 <= math.dist(offer.handoff, offer.dropoff.anchor) <= 5000.0


def test_city_without_homes() -> None:
    class Bare:
        name, pois = "bare", ()

    with pytest.raises(ValueError, match="0 restaurants and 0 plain buildings"):
        OrderBook(Bare(), ORIGINAL, 0)  # type: ignore[arg-type]


def test_pick_scores() -> None:
    book = OrderBook(tiny(), ORIGINAL, 0)
    pool = [book[n] for n in range(10)]
    scores = pick_scores(tiny(), pool, [(0.0, 0.0)])
    # Each of three rankings of 10 gives 0, 1/9, ... 1: the sum of all scores is 10 + 4 * 5, whatever the order.
    assert sum(scores.values()) == pytest.approx(30.0)
    assert all(1.0 <= score <= 5.0 for score in scores.values())
    assert pick_scores(tiny(), pool[:1], [(0.0, 0.0)]) == {0: 5.0}


def test_accepting() -> None:
    w = world()
    refuse(w, "ACCEPT_ORDER()", "PARSE_ARGS")
    refuse(w, "ACCEPT_ORDER(order_id=[])", "PARSE_ARGS")
    refuse(w, "ACCEPT_ORDER(77)", "ACC_NONE")
    do(w, "ACCEPT_ORDER([3, 77, 3])")
    assert list(w.state.orders) == [3]
    assert w.state.pool == [0, 1, 2, 4, 5, 6, 7, 8, 9, 10]
    refuse(w, "ACCEPT_ORDER(3)", "ACC_NONE")
    do(w, "ACCEPT_ORDER(0)")
    do(w, 'ACCEPT_ORDER(order_id="5")')
    assert list(w.state.orders) == [3, 0, 5]


def test_pickup_place_and_time() -> None:
    w = world()
    refuse(w, "PICKUP(orders=[424242])", "PU_NO_ORDERS")
    refuse(w, "PICKUP(orders=[1])", "PU_NOTHING")
    do(w, "ACCEPT_ORDER(1)")
    order = w.state.orders[1]
    w.state.position = order.offer.pickup.anchor
    do(w, f"WAIT({order.offer.prep - 0.1})")
    refuse(w, "PICKUP(orders=[1])", "PU_NOTHING")
    do(w, "WAIT(0.1)")
    stand(w, "charging_station")
    refuse(w, "PICKUP(orders=[1])", "PU_NOTHING")
    # 600 cm is near enough, 601 is not.
    x, y = order.offer.pickup.anchor
    w.state.position = (x + 601.0, y)
    refuse(w, "PICKUP(orders=[1])", "PU_NOTHING")
    w.state.position = (x + 600.0, y)
    do(w, "PICKUP(orders=[1, 2, 99])")
    assert [item.temp for item in order.items] == [food.serving for food in order.offer.foods]
    assert order.pending == order.items and w.state.carrying == [1]


def test_food_waits_in_the_restaurant() -> None:
    w = world()
    do(w, "ACCEPT_ORDER(1)")
    order = w.state.orders[1]
    do(w, f"WAIT({order.offer.prep + 1800})")
    w.state.position = order.offer.pickup.anchor
    do(w, "PICKUP(orders=[1])")
    # 1800 s after it was ready: 22 + (serving - 22) / e.
    assert [item.temp for item in order.items] == pytest.approx(
        [22.0 + (food.serving - 22.0) / math.e for food in order.offer.foods]
    )
