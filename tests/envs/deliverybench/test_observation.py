"""What the agent reads: complete, static where it must be, short where it must be, and never invalid text."""

from __future__ import annotations

import json

import pytest

from agentspec.envs.deliverybench.city.generate import generate
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.view.cards import OfferCards, describe
from agentspec.envs.deliverybench.view.observation import around, compact_text, full_text, instruction, surroundings
from agentspec.envs.deliverybench.world.engine import World
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
    # The allowed methods are not told; the note is.
    assert "methods" not in order and order["note"] == offer.note


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
    assert len(text) < (500 if menu else 1500)


def test_full_text_has_its_sections_in_order() -> None:
    world, cards = fresh()
    for action in ("ACCEPT_ORDER([0])", "FLY()", "VIEW_ORDERS()", "DROP_OFF(oid=0, method='knock')"):
        world.step(action)
    view = describe(world, cards)
    text = full_text(view, around(world.city, world.state.position, view))
    titles = [
        "on the clock",
        "Your orders",
        "Hands and bag",
        "Orders on offer",
        "Around you",
        "Recent actions",
        "Last error",
    ]
    positions = [text.index(title) for title in titles]
    assert positions == sorted(positions)
    assert "viewed the orders on offer (newest)" in text and "not picked up yet" in text
    assert world.book[0].pickup.road in text


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
    assert "order 0: ready, 2 min late" in text  # 61 s over the limit, whole minutes rounded up
    x, y = (c / 100 for c in world.city.pois_of("charging_station")[0].anchor)
    world.step(f"MOVE({x:.2f}m, {y:.2f}m)")
    world.step("CHARGE(target_pct=80)")
    view = describe(world, cards)
    assert view["mode"] == "walk" and "charging to 80 %" in full_text(view, "")
    assert "charging" in compact_text(view, "", ())


def test_compact_text_stays_short_throughout_an_episode() -> None:
    from agentspec.envs.deliverybench.expert.courier import RandomCourier

    env = DeliveryBenchEnv(size="medium", observation="compact", action_mode="menu", max_steps=80)
    observation, info = env.reset(seed=1)
    courier = RandomCourier()
    ended = False
    while not ended:
        assert len(observation["text"]) <= 700
        observation, _, terminated, truncated, info = env.step(courier.act(info))
        ended = terminated or truncated
