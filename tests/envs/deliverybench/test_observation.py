"""What the agent reads: complete, static where it must be, short where it must be, and never invalid text."""

from __future__ import annotations

import json
import math
import random
import re

import pytest

from agentspec.envs.deliverybench.city.generate import generate
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier
from agentspec.envs.deliverybench.view.cards import OfferCards, describe, metres
from agentspec.envs.deliverybench.view.compact import compact_text
from agentspec.envs.deliverybench.view.full import around, full_text, surroundings
from agentspec.envs.deliverybench.view.hints import hints
from agentspec.envs.deliverybench.view.instruction import instruction
from agentspec.envs.deliverybench.view.wording import exactly
from agentspec.envs.deliverybench.world.engine import World
from agentspec.envs.deliverybench.world.grammar import advertised, schema_for
from agentspec.envs.deliverybench.world.notes import METHODS
from agentspec.envs.deliverybench.world.rules import rules_named


def fresh(**options) -> tuple[World, OfferCards]:
    world = World(generate("tiny", 0), **options)
    return world, OfferCards(world.book)


def test_view_is_json_and_in_metres_and_dollars() -> None:
    world, cards = fresh()
    world.step("ACCEPT_ORDER([0])")
    view = describe(world, cards)
    assert json.loads(json.dumps(view)) == view
    offer = world.book[0]
    (order,) = view["orders"]
    assert order["pickup_xy"] == [round(c / 100, 2) for c in offer.pickup.anchor]
    assert order["pay"] == round(offer.pay, 2) and order["status"] == "preparing"
    assert order["ready_in_s"] == float(offer.prep) and order["time_left_s"] == round(offer.limit, 1)
    assert view["battery"] == 50.0 and view["range_m"] == 1250.0  # 50 % at 0.04 % per metre
    assert [o["id"] for o in view["offers"]] == world.state.pool and 0 not in world.state.pool
    # The note is told at once; which methods it allows only at the customer's.
    assert order["methods"] == [] and order["note"] == offer.note


def test_view_follows_an_order() -> None:
    world, cards = fresh()
    offer = world.book[0]
    world.step("ACCEPT_ORDER([0])")
    x, y = (c / 100 for c in offer.pickup.anchor)
    world.step(f"MOVE({x:.2f}m, {y:.2f}m)")
    view = describe(world, cards)
    assert view["place"] == offer.pickup.name and offer.pickup.name in view["here"]
    world.step(f"WAIT({max(1.0, view['orders'][0]['ready_in_s'])})")
    assert describe(world, cards)["orders"][0]["status"] == "ready"
    world.step("PICKUP(orders=[0])")
    (order,) = describe(world, cards)["orders"]
    assert order["status"] == "in hand" and order["hand"] == order["items"]
    numbers = ",".join(str(i + 1) for i in range(len(offer.foods)))
    world.step(f'PLACE_FOOD_IN_BAG(bag_cmd="order 0: {numbers} -> B")')
    view = describe(world, cards)
    assert view["orders"][0]["status"] == "in bag" and view["orders"][0]["hand"] == []
    assert [item["name"] for item in view["bag"]["B"]["items"]] == order["items"]


def test_handoff_point_is_told_only_where_it_is_not_hidden() -> None:
    for rules, told in (("fair", True), ("original", False)):
        world, cards = fresh(rules=rules)
        number = next(n for n in range(200) if world.book[n].handoff is not None)
        while number not in world.state.pool:
            world.state.pool.append(number)
        world.step(f"ACCEPT_ORDER([{number}])")
        shown = describe(world, cards)["orders"][0]["handoff_xy"]
        assert (shown is not None) is told


def test_instruction_is_static_and_free_of_the_answer_format() -> None:
    env = DeliveryBenchEnv(size="tiny")
    _, info = env.reset(seed=0)
    first = info["instruction"]
    for action in ("VIEW_ORDERS()", "ACCEPT_ORDER([0])", "nonsense"):
        assert env.step(action)[4]["instruction"] == first
    assert "ACCEPT_ORDER" not in first and "energy_drink $6" in first
    assert all(poi.name in first for kind in ("restaurant", "store", "hospital") for poi in env.city.pois_of(kind))


@pytest.mark.parametrize("menu", [False, True])
def test_compact_instruction_is_short(menu: bool) -> None:
    text = instruction(generate("large", 0), rules_named("fair"), 1.0, compact=True, menu=menu)
    assert len(text) < (800 if menu else 2200)


def test_full_text_has_its_sections_in_order() -> None:
    world, cards = fresh()
    for action in ("ACCEPT_ORDER([0])", "FLY()", "VIEW_ORDERS()", "DROP_OFF(oid=0, method='knock')"):
        world.step(action)
    view = describe(world, cards)
    text = full_text(view, around(world.city, world.state.position, view), message="looked at the bag")
    titles = [
        "on the clock",
        "Your orders",
        "Hands and bag",
        "Orders on offer",
        "Around you",
        "Last action",
        "Last error",
    ]
    positions = [text.index(title) for title in titles]
    assert positions == sorted(positions)
    assert "not picked up yet" in text
    assert world.book[0].pickup.road in text


def test_what_the_last_action_did_stands_in_the_text_once_and_what_came_before_does_not() -> None:
    """The full text used to list five recent actions, which a transcript or a memory tells as well, and no payment."""
    env = DeliveryBenchEnv(size="tiny")
    text = env.reset(seed=0)[0]["text"]
    assert "Last action" not in text
    for action, told in (("VIEW_BAG()", "viewed the bag"), ("WAIT(7)", "waited 7s"), ("FLY()", "failed: ")):
        text = env.step(action)[0]["text"]
        assert text.count(told) == 1 and f"Last action: {told}" in text, text
        assert text.count("FLY") <= 1 and ("viewed the bag" in text) is (action == "VIEW_BAG()")
    courier, info, paid = RuleBasedCourier(env.city), env.observe()[1], ""
    while not paid:
        observation, reward, _, _, info = env.step(courier.act(info))
        paid = f"${reward:.2f}" if "delivered" in info["events"] else ""
    assert f"stars, {paid}" in observation["text"].partition("Last action: ")[2]


def test_times_are_told_to_the_second_and_once() -> None:
    """`5 min left` used to mean anything above four, and a hint rounded the same wait another way."""
    assert [exactly(s) for s in (0.0, 59.4, 60.0, 185.0, 3600.0, 4800.0)] == [
        *("0 s", "59 s", "1 min", "3 min 5 s", "1 h", "1 h 20 min")
    ]
    world, cards = fresh()
    world.step("ACCEPT_ORDER([0])")
    placed(world, world.book[0].pickup.anchor)
    world.step(f"WAIT({world.book[0].prep - 65})")
    view = describe(world, cards)
    for text in (full_text(view, ""), compact_text(view, "")):
        assert "ready in 1 min 5 s" in text and text.count("1 min 5 s") == 1
        assert "wait until order 0 is ready: WAIT(65)" in text


def test_a_place_has_the_same_coordinates_in_the_rules_and_in_the_offers() -> None:
    """(175.8m, 75.3m) in the list of places was (175.8m, 75.2m) on the board: two roundings of 75.25."""
    for seed in range(4):
        env = DeliveryBenchEnv(size="small", city_seed=seed)
        observation, info = env.reset(seed=0)
        observation = env.step("VIEW_ORDERS()")[0]
        where = dict(re.findall(r"From (restaurant \d+) (\(.*?\))", observation["text"]))
        assert where and all(f"{name} {point}" in info["instruction"] for name, point in where.items())


def test_the_rules_tell_what_a_plan_rests_on() -> None:
    text = instruction(generate("tiny", 0), rules_named("fair"), 1.0, compact=False, menu=False)
    # Popsicles take 30 s, curry 420 s; ten orders at a time; after 60 s the pay shrinks, to half at worst.
    assert "the time allowed begins" in text and "starts cooking (1 to 7 min)" in text
    assert "(at most 10)" in text and "From 60s late on the pay shrinks, down to 50 %" in text
    assert "Otherwise only moving, waiting, resting and the bus take time" in text
    assert "Smelly: Coffee, Durian, StinkyTofu, BlueCheese." in text and "Fragile: Noodles, Salad" in text


def test_offers_are_listed_only_after_looking_at_them() -> None:
    world, cards = fresh()
    view = describe(world, cards)
    assert "10 orders are on offer; VIEW_ORDERS() lists them" in full_text(view, "")
    world.step("VIEW_ORDERS()")
    assert "- order 9: $" in full_text(describe(world, cards), "")


def test_surroundings_are_sorted_and_reachable() -> None:
    world, _ = fresh()
    found = surroundings(world.city, world.state.position, limit=3)
    for points in found.values():
        metres = [d for _, _, d in points]
        assert len(points) == 3 and metres == sorted(metres)
    # As near as a look at every node of the city finds them.
    field, graph = world.city.distances_from(world.state.position), world.city.walk
    for kind, points in (("normal", found["ways"]), ("intersection", found["junctions"])):
        every = sorted((field.to_node(i), i) for i, k in enumerate(graph.kinds) if k == kind)
        nearest = [graph.points[i] for d, i in every if d > 0.0][:3]
        assert [xy for _, xy, _ in points] == [(x / 100, y / 100) for x, y in nearest]
    assert found["junctions"][0][1] in {(x / 100, y / 100) for x, y in world.city.walk.points}


def test_late_orders_and_charging_are_shown() -> None:
    world, cards = fresh()
    world.step("ACCEPT_ORDER([0])")
    world.step(f"WAIT({world.book[0].limit + 61})")
    text = full_text(describe(world, cards), "")
    # 61 s over the limit, and a tenth of a second at most by which the limit is no whole number of seconds.
    assert "order 0: ready, 1 min 1 s late" in text
    x, y = (c / 100 for c in world.city.pois_of("charging_station")[0].anchor)
    world.step(f"MOVE({x:.2f}m, {y:.2f}m)")
    world.step("CHARGE(target_pct=80)")
    view = describe(world, cards)
    assert view["mode"] == "walk" and "charging to 80 %" in full_text(view, "")
    assert "charging" in compact_text(view, "")


def test_compact_text_stays_short_throughout_an_episode() -> None:
    from agentspec.envs.deliverybench.expert.scripted import luck

    env = DeliveryBenchEnv(size="medium", observation="compact", action_mode="menu", max_steps=80)
    observation, info = env.reset(seed=1)
    courier = luck({}, random.Random(0))
    ended = False
    while not ended:
        assert len(observation["text"]) <= 1000
        observation, _, terminated, truncated, info = env.step(courier.act(info))
        ended = terminated or truncated


def placed(world: World, point: tuple[float, float], dx: float = 0.0) -> None:
    """Put the courier beside a point (cm)."""
    world.state.position = (point[0] + dx, point[1])


def test_what_is_in_reach_is_here_and_nothing_else_is() -> None:
    """456 of 456 places in reach used to be shown as 8 to 16 m away."""
    city = generate("small", 0)
    world = World(city, seed=0)
    cards, kinds = OfferCards(world.book), ("charging_station", "store", "rest_area", "car_rental", "bus_station")
    for poi in (poi for kind in kinds for poi in city.pois_of(kind)):
        # 3 m beside it, within the 5 m that are in reach though the way along the street is longer; and 30 m beside it.
        for dx, here in ((300.0, True), (3000.0, False)):
            placed(world, poi.anchor, dx)
            view = describe(world, cards)
            view["nearest"] = {poi.kind: {"name": poi.name, "xy": metres(poi.anchor), "m": 12}}
            x, y = metres(poi.anchor)
            text = around(city, world.state.position, view)
            assert f"{poi.name} ({x:.1f}m, {y:.1f}m) {'here' if here else '12m'}" in text


def test_orders_in_reach_are_here_in_both_texts() -> None:
    world, cards = fresh()
    world.step("ACCEPT_ORDER([0])")
    placed(world, world.book[0].pickup.anchor, 300.0)
    view = describe(world, cards)
    assert view["orders"][0]["to_pickup_m"] > 3 and "(here), from there" in full_text(view, "")
    assert re.search(r"order 0: .* here, ", compact_text(view, ""))


def test_accepted_orders_keep_their_details_and_temperatures() -> None:
    world, cards = fresh()
    world.step("VIEW_ORDERS()")
    number = next(n for n in world.state.pool if world.book[n].note)
    offer = world.book[number]
    world.step(f"ACCEPT_ORDER([{number}])")
    text, short = (full_text(describe(world, cards), ""), compact_text(describe(world, cards), ""))
    for shown in (text, short):
        assert f'"{offer.note}"' in shown and f"{offer.distance / 100:.0f}m" in shown and f"${offer.pay:.2f}" in shown
        assert all(f"{food.name} {food.serving:.0f}C" in shown for food in offer.foods)
    placed(world, offer.pickup.anchor)
    world.step(f"WAIT({offer.prep + 300})")
    world.step(f"PICKUP(orders=[{number}])")
    view = describe(world, cards)
    for i, dish in enumerate(view["orders"][0]["dishes"], start=1):
        # 300 s on the counter at 22 C: the excess over it shrinks by exp(-300 / 1800).
        expected = 22.0 + (dish["serve"] - 22.0) * math.exp(-300.0 / 1800.0)
        assert dish["temp"] == pytest.approx(expected, abs=0.06)
        assert f"{i} {dish['name']} {dish['temp']:.0f}C" in full_text(view, "")
        assert f"{dish['name']} {dish['temp']:.0f}/{dish['serve']:.0f}C" in compact_text(view, "")


def test_what_is_in_the_bag_says_whose_it_is() -> None:
    world, cards = fresh()
    collect_all(world, 0)
    world.step('PLACE_FOOD_IN_BAG(bag_cmd="order 0: 1 -> C")')
    assert re.search(r"C\.1 \w+ -?\d+C \(order 0\)", full_text(describe(world, cards), ""))


def collect_all(world: World, *numbers: int) -> None:
    world.step(f"ACCEPT_ORDER({list(numbers)})")
    world.step("WAIT(420)")
    for number in numbers:
        placed(world, world.book[number].pickup.anchor)
        world.step(f"PICKUP(orders=[{number}])")


def test_hints_can_be_carried_out_as_they_stand() -> None:
    """Every complete call in a hint succeeds where the hint is given."""
    tried: dict[str, int] = {}
    env = DeliveryBenchEnv(size="small", city_seed=1)
    _, info = env.reset(seed=3)
    courier = RuleBasedCourier(env.city)
    for _ in range(120):
        for hint in hints(info["state"]):
            for call in re.findall(r"\b[A-Z_]{4,}\((?:[^()\"]|\"[^\"]*\")*\)", hint):
                assert "..." not in call
                blob = env.snapshot()
                told = env.step(call)[4]
                assert not told["invalid"], (hint, told["error"])
                tried[call.partition("(")[0]] = tried.get(call.partition("(")[0], 0) + 1
                env.restore(blob)
        *_, info = env.step(courier.act(info))
    assert {"PICKUP", "PLACE_FOOD_IN_BAG", "DROP_OFF"} <= set(tried) and sum(tried.values()) > 60


def test_hints_tell_the_wanted_hand_over() -> None:
    for rules in ("fair", "original"):
        world, cards = fresh(rules=rules)
        number = next(n for n in range(300) if world.book[n].methods == ("knock",))
        world.state.pool[0] = number
        collect_all(world, number)
        placed(world, world.book[number].dropoff.anchor)
        (hint,) = [line for line in hints(describe(world, cards)) if line.startswith("deliver")]
        if rules == "fair":
            assert f'DROP_OFF(oid={number}, method="knock"); the note asks for knock' in hint
        else:
            assert all(method in hint for method in METHODS) and world.book[number].note in hint


def test_hints_of_services() -> None:
    world, cards = fresh()

    def told(kind: str) -> str:
        placed(world, world.city.pois_of(kind)[0].anchor)
        return " | ".join(hints(describe(world, cards)))

    # 50 % at 7.5 %/min and 0.05 $/%: 400 s are 7 minutes, rounded.
    assert "CHARGE(target_pct=100) takes 7 min and costs $2.50" in told("charging_station")
    assert 'BUY(item_id="energy_drink", qty=1), or escooter_battery_pack, ice_pack or heat_pack' in told("store")
    assert "RENT_CAR()" in told("car_rental") and "RETURN_CAR()" not in told("car_rental")
    assert "REST" not in told("rest_area")  # nothing to rest from
    world.state.energy = 25.0
    assert "REST(target_pct=100) takes 10 min" in told("rest_area")
    world.step("RENT_CAR()")
    placed(world, world.timetable.stops[0])
    assert "bus" in " ".join(hints(describe(world, cards)))


def test_values_of_all_parameters_are_told() -> None:
    """What a parameter may be stands in the description of its action, not only in the schema."""
    for spec in advertised(schema_for(rules_named("fair"))).actions.values():
        for parameter in spec.parameters.values():
            for value in parameter.enum:
                assert value in spec.description, (spec.name, value)
    assert "escooter_battery_pack" in schema_for(rules_named("fair")).actions["BUY"].description


def test_rules_against_wasted_steps_are_told() -> None:
    for compact in (False, True):
        text = instruction(generate("tiny", 0), rules_named("fair"), 1.0, compact=compact, menu=False)
        assert "do not look again while they are shown (that costs 10s)" in text
        assert "Do not repeat an action that has just failed" in text and "finish what you accepted" in text
        assert "plan" in text
    assert "10s" not in instruction(generate("tiny", 0), rules_named("original"), 1.0, compact=False, menu=False)


def test_a_plan_is_shown_again() -> None:
    env = DeliveryBenchEnv(size="tiny")
    env.reset(seed=0)
    observation, *_, info = env.step('{"action": "VIEW_BAG()", "plan": "Accept 3,\\nthen ride."}')
    assert not info["invalid"] and "Your plan: Accept 3, then ride." in observation["text"]
    blob = env.snapshot()
    observation, *_ = env.step("WAIT(1)")
    assert "Your plan: Accept 3, then ride." in observation["text"]
    observation, *_ = env.step('```json\n{"action": "WAIT(1)", "future_plan": "rest"}\n```')
    assert "Your plan: rest" in observation["text"]
    env.restore(blob)
    assert "Your plan: Accept 3, then ride." in env.observe()[0]["text"]
    assert "Your plan" not in env.reset(seed=0)[0]["text"]


def test_full_text_with_a_menu_says_each_thing_once() -> None:
    env = DeliveryBenchEnv(size="tiny", action_mode="menu")
    observation, info = env.reset(seed=0)
    text = observation["text"]
    assert "Here you can" not in text and "VIEW_ORDERS" not in text and "- order 9: $" in text
    assert all(f"- {choice}" in text for choice in info["action_schema"].choices)
    assert not any(line.startswith("- accept order") and "$" in line for line in text.splitlines())
