"""The rule book: numbers, settings, and one exploit per switch: possible under "original", gone under "fair"."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise

import pytest

from agentspec.envs.deliverybench.view.cards import OfferCards, describe
from agentspec.envs.deliverybench.world.bag import Item
from agentspec.envs.deliverybench.world.engine import World
from agentspec.envs.deliverybench.world.food import COLD, HOT, MENU
from agentspec.envs.deliverybench.world.packing import suggestion
from agentspec.envs.deliverybench.world.rules import FAIR, ORIGINAL, quirk_table, quirks, rules_named
from tests.envs.deliverybench.helpers import (
    REFERENCE,
    collect,
    do,
    metres,
    needs_reference,
    off,
    refuse,
    stand,
    tiny,
    world,
)

BOTH = ("original", "fair")


def test_rule_sets() -> None:
    names = list(quirks())
    assert all(getattr(ORIGINAL, name) for name in names) and not any(getattr(FAIR, name) for name in names)
    assert (
        replace(FAIR, name="original", max_calls=200, max_active_orders=None, **dict.fromkeys(names, True)) == ORIGINAL
    )
    assert rules_named("fair") is FAIR and rules_named(ORIGINAL) is ORIGINAL
    with pytest.raises(ValueError, match="unknown rule set 'cosy'"):
        rules_named("cosy")


def test_every_switch_has_a_test() -> None:
    tested = {name.removeprefix("test_quirk_") for name in globals() if name.startswith("test_quirk_")}
    assert tested == set(quirks())


def test_table_lists_every_switch() -> None:
    lines = quirk_table().splitlines()
    assert len(lines) == 2 + len(quirks())
    assert all(f"| `{name}` | {text} | on | off |" in lines for name, text in quirks().items())


@needs_reference
def test_numbers_equal_the_reference_settings() -> None:
    config = json.loads((REFERENCE / "game_mechanics.json").read_text())
    assert ORIGINAL.with_config(config) == ORIGINAL
    assert ORIGINAL.food_rate == pytest.approx(config["k_food_per_s"])


def test_settings() -> None:
    rules = FAIR.with_config({"initial_earnings": 7, "avg_speed_cm_s": {"walk": 100}, "bus": {"waiting_time_s": 60}})
    assert (rules.initial_balance, rules.speed["walk"], rules.speed["car"], rules.bus_dwell) == (
        7.0,
        100.0,
        1200.0,
        60.0,
    )
    assert FAIR.speed["walk"] == 200.0
    with pytest.raises(ValueError, match="initial_earnings"):
        FAIR.with_config({"initial_earnings": "much"})


# -- one exploit per switch ------------------------------------------------------------------------------------


def test_quirk_hand_food_is_inert() -> None:
    worst = {}
    for rules in BOTH:
        w = world(rules)
        collect(w, 1)
        item = w.state.orders[1].items[0]
        before = item.temp
        do(w, "WAIT(1800)")
        w.look()
        worst[rules] = (item.temp, before)
    assert worst["original"][0] == worst["original"][1]
    # 1800 s in the open: 1/e of the gap to 22 degrees is left.
    got, before = worst["fair"]
    assert got == pytest.approx(22.0 + (before - 22.0) / math.e)


def test_hand_food_is_shaken_in_fair() -> None:
    for rules, damage in (("original", 0), ("fair", 1)):
        w = world(rules)
        number = next(n for n in range(50) if any(food.fragile for food in w.book[n].foods))
        w.state.pool[0] = number
        collect(w, number)
        # On foot, because nothing else moves with food in the hand under fair rules.
        do(w, 'SWITCH("walk")')
        store = tiny().pois_of("hospital")[0].anchor
        w.step(f'MOVE({metres(store)}, pace="accel")')
        assert max(item.damage for item in w.state.orders[number].items) == damage


def test_quirk_ride_with_food_in_hand() -> None:
    for rules in BOTH:
        w = world(rules)
        collect(w, 0)
        target = metres(off(w.state.position, 0.0, 20_000.0))
        if rules == "original":
            do(w, f"MOVE({target})")
            do(w, "STEP_FORWARD()")
            continue
        message = refuse(w, f"MOVE({target})", "MV_FOOD_IN_HAND").message
        refuse(w, "STEP_FORWARD()", "MV_FOOD_IN_HAND")
        # On foot it may be carried, and the command that the refusal suggests frees the hands.
        do(w, 'SWITCH("walk")')
        do(w, "STEP_FORWARD()")
        do(w, 'SWITCH("e-scooter")')
        do(w, message[message.index("PLACE") : message.index(", or go")])
        do(w, f"MOVE({target})")


def test_suggested_bag_command_keeps_hot_and_cold_apart() -> None:
    w = world("fair")
    number = next(n for n in range(200) if {food.category for food in w.book[n].foods} >= {HOT, COLD})
    w.state.pool[0] = number
    collect(w, number)
    do(w, f"PLACE_FOOD_IN_BAG(bag_cmd={suggestion(w.state.orders.values())!r})")
    for label, category in (("A", HOT), ("B", COLD)):
        items = w.state.bag.compartments[label].items
        assert items and all(item.food is not None and item.food.category == category for item in items)


def test_quirk_placing_freezes_food() -> None:
    frozen = {}
    for rules in BOTH:
        w = world(rules)
        collect(w, 0, 1)
        do(w, 'PLACE_FOOD_IN_BAG(bag_cmd="order 0: 1 -> A")')
        do(w, 'PLACE_FOOD_IN_BAG(bag_cmd="order 1: 1 -> A")')
        item = w.state.orders[0].items[0]
        before = item.temp
        do(w, "WAIT(600)")
        w.look()
        frozen[rules] = item.temp == before
    assert frozen == {"original": True, "fair": False}


def test_quirk_ride_parked_scooter() -> None:
    for rules, state in (("original", "parked"), ("fair", "usable")):
        w = world(rules)
        refuse(w, 'SWITCH("bicycle")', "SW_BAD_TARGET")
        assert (w.state.mode, w.state.scooter.state) == ("e-scooter", state)


def test_quirk_rest_above_full() -> None:
    for rules, energy in (("original", 120.0), ("fair", 100.0)):
        w = world(rules)
        stand(w, "rest_area")
        do(w, "REST(120)")
        assert w.state.energy == energy


def test_quirk_return_absent_car() -> None:
    for rules in BOTH:
        w = world(rules)
        here = stand(w, "car_rental")
        do(w, "RENT_CAR()")
        w.state.position = off(here, 5000.0)
        do(w, 'SWITCH("walk")')
        w.state.position = here
        if rules == "original":
            do(w, "RETURN_CAR()")
        else:
            refuse(w, "RETURN_CAR()", "RT_NOT_HERE")


def test_quirk_charging_ends_waits() -> None:
    for rules, seconds in (("original", 80.0), ("fair", 600.0)):
        w = world(rules)
        stand(w, "charging_station")
        do(w, "CHARGE(60)")
        assert do(w, "WAIT(600)").seconds == seconds


def test_quirk_hanging_wait() -> None:
    assert world("original").step('WAIT("charge_done")').ended
    refuse(world("fair"), 'WAIT("charge_done")', "WT_NO_SESSION")


def ride(rules: str, mode: str) -> tuple[World, float]:
    """A bus ride between two stops, begun on foot or on the scooter; the world and the length of the jump (m)."""
    w = world(rules)
    first, second = w.timetable.names[:2]
    do(w, f"WAIT({w.timetable.arrival(first, 0) / 10})")
    w.state.position = w.timetable.stops[0]
    do(w, f'SWITCH("{mode}")')
    do(w, f'BOARD_BUS(bus_id="bus_1", target_stop_id="{second}")')
    return w, math.dist(*w.timetable.stops[:2]) / 100.0


def test_quirk_bus_ride_costs_walking() -> None:
    for rules, rate in (("original", 0.08), ("fair", 0.006)):
        w, length = ride(rules, "walk")
        assert 100.0 - w.state.energy == pytest.approx(rate * length, rel=1e-4)


def test_quirk_bus_carries_vehicle() -> None:
    for rules, mode, where in (("original", "e-scooter", None), ("fair", "walk", "stop")):
        w, _ = ride(rules, "e-scooter")
        assert w.state.mode == mode
        assert w.state.scooter.park == (w.timetable.stops[0] if where else None)


def test_quirk_hospital_carries_vehicle() -> None:
    for rules in BOTH:
        w = world(rules)
        w.state.energy = 0.1
        target = max((p.anchor for p in tiny().pois), key=lambda p: math.dist(p, w.state.position))
        refuse(w, f"MOVE({metres(target)})", "MV_COLLAPSED")
        # 0.1 % is 10 m of riding; the jump to the hospital then drains the battery as well, or the scooter stays.
        drained = 50.0 - w.state.scooter.battery
        assert w.state.mode == ("e-scooter" if rules == "original" else "walk")
        assert (w.state.scooter.park is None) == (rules == "original")
        assert (drained > 0.45) == (rules == "original")


def test_quirk_ghost_car() -> None:
    for rules, mode in (("original", "car"), ("fair", "walk")):
        w = world(rules)
        stand(w, "car_rental")
        w.pay("purchases", -99.0)
        do(w, "RENT_CAR()")
        do(w, "WAIT(120)")
        assert (w.state.mode, w.state.car, w.state.balance) == (mode, None, 0.0)
        before = w.state.balance
        w.step(f"MOVE({metres(tiny().pois_of('hospital')[0].anchor)})")
        assert w.state.balance == before


def test_quirk_bare_pickup_fails() -> None:
    for rules in BOTH:
        w = world(rules)
        do(w, "ACCEPT_ORDER(1)")
        do(w, "WAIT(420)")
        w.state.position = w.state.orders[1].offer.pickup.anchor
        if rules == "original":
            refuse(w, "PICKUP()", "PU_NO_ORDERS")
        else:
            do(w, "PICKUP()")


def test_quirk_zero_id_fails() -> None:
    refuse(world("original"), "ACCEPT_ORDER(order_id=0)", "PARSE_ARGS")
    do(world("original"), "ACCEPT_ORDER(0)")
    do(world("fair"), "ACCEPT_ORDER(order_id=0)")


def test_quirk_bare_numbers_are_cm() -> None:
    for rules in BOTH:
        w = world(rules)
        x, y = tiny().pois_of("store")[0].anchor
        outcome = do(w, f"MOVE({x / 100:.0f}, {y / 100:.0f})")
        # A few cm away is where the courier stands already.
        assert (outcome.seconds == 0.0) == (rules == "original")
        assert math.dist(w.state.position, (x, y)) < 500.0 or rules == "original"
        do(w, f"MOVE({metres((x, y))})")
        assert math.dist(w.state.position, (x, y)) < 500.0


def test_quirk_strict_reading() -> None:
    one_line = '```json {"action": "VIEW_BAG()"} ```'
    refuse(world("original"), one_line, "PARSE_NOT_CALL")
    do(world("original"), one_line.replace(" {", "\n{").replace("} ", "}\n"))
    do(world("fair"), one_line)


def test_quirk_handoff_hidden() -> None:
    for rules in BOTH:
        w = world(rules, seed=3)
        number = next(n for n in range(200) if w.book[n].handoff is not None)
        w.state.pool[0] = number
        collect(w, number)
        point = w.state.orders[number].offer.handoff
        assert point is not None
        w.state.position = off(point, 6000.0)
        outcome = refuse(w, f'DROP_OFF({number}, "hand_to_customer")', "DO_NOT_AT_CUSTOMER")
        assert (f"({point[0] / 100:.2f}m" in outcome.message) == (rules == "fair")


def test_quirk_odd_bus_line() -> None:
    # The terminal twice in a row, or not.
    for rules in BOTH:
        bus = world(rules).timetable
        stops, tick = [], 0
        while len(stops) < 6:
            phase = bus.phase(tick)
            assert phase is not None
            if phase.stopped and (not stops or stops[-1][0] != phase.tick):
                stops.append((phase.tick, phase.stop))
            tick += 50
        names = [name for _, name in stops]
        repeats = any(a == b for a, b in pairwise(names))
        assert repeats == (rules == "original"), names


def test_quirk_stale_error() -> None:
    for rules in BOTH:
        w = world(rules)
        refuse(w, "REST(100)", "RE_NO_AREA")
        w.state.scooter.battery = 0.5
        target = max((p.anchor for p in tiny().pois), key=lambda p: math.dist(p, w.state.position))
        refuse(w, f"MOVE({metres(target)})", "MV_DEPLETED")
        assert ("REST" in w.state.error) == (rules == "original")
        assert ("battery" in w.state.error) == (rules == "fair")


def test_quirk_drag_keeps_charging() -> None:
    for rules in BOTH:
        w = world(rules)
        stand(w, "charging_station")
        do(w, "CHARGE(100)")
        do(w, 'SWITCH("drag_scooter")')
        assert (w.state.charging is None) == (rules == "fair")
        do(w, "WAIT(1)")
        # Nothing is charged either way.
        assert w.state.charging is None and w.state.scooter.battery == 50.0


def test_quirk_vanishing_food() -> None:
    for rules in BOTH:
        w = world(rules)
        collect(w, 1)
        count = len(w.state.orders[1].pending)
        outcome = w.step('PLACE_FOOD_IN_BAG(bag_cmd="order 1: x 1 y -> A")')
        if rules == "original":
            assert outcome.ok and len(w.state.orders[1].pending) == count - 1 and not list(w.state.bag.items())
        else:
            assert outcome.code == "BAG_SYNTAX" and len(w.state.orders[1].pending) == count


def test_quirk_equal_food_vanishes() -> None:
    for rules, left in (("original", 0), ("fair", 1)):
        w = world(rules)
        collect(w, 0, 1)
        burger = MENU[0]
        for number in (0, 1):
            order = w.state.orders[number]
            order.items = [Item("Burger", burger, number, burger.capacity, 60.0, 0.0, 0, 3000, 4200)]
            order.pending = list(order.items)
        do(w, 'PLACE_FOOD_IN_BAG(bag_cmd="order 0: 1 -> A order 1: 1 -> A")')
        do(w, "WAIT(100)")
        w.state.position = w.state.orders[0].offer.dropoff.anchor
        do(w, 'DROP_OFF(0, "knock")')
        assert len(list(w.state.bag.items())) == left


def test_quirk_free_last_metres() -> None:
    seconds = {}
    for rules in BOTH:
        w = world(rules)
        seconds[rules] = do(w, f"MOVE({metres(off(w.state.position, 0.0, 50_000.0))})").seconds
        rest = do(w, "STEP_FORWARD()").seconds
        assert (rest == 0.0) == (rules == "original")
    # At most 500 - 136.6 cm at 60 cm a tick: 0.7 s.
    assert 0.5 < seconds["fair"] - seconds["original"] < 0.75


def test_quirk_views_after_parse_errors() -> None:
    for rules in BOTH:
        w = world(rules)
        for _ in range(6):
            refuse(w, "hm", "PARSE_NOT_CALL")
        assert (w.recorder.successes["VIEW_ORDERS"] == 1) == (rules == "original")
        assert ("orders" in [notice.kind for notice in w.state.notices]) == (rules == "original")


def test_quirk_free_looks() -> None:
    for rules in BOTH:
        w = world(rules)
        for look in ("VIEW_ORDERS()", "VIEW_BAG()", "VIEW_BUS_SCHEDULE()", "VIEW_HELP_BOARD()"):
            assert do(w, look).seconds == 0.0
            # A second look at what is shown anyway costs ten seconds, so nobody can look for ever at clock 0.
            assert do(w, look).seconds == (0.0 if rules == "original" else 10.0)
        do(w, "ACCEPT_ORDER([0])")
        assert do(w, "VIEW_ORDERS()").seconds == 0.0


def test_quirk_methods_hidden() -> None:
    for rules in BOTH:
        w = world(rules, seed=3)
        number = next(n for n in range(200) if w.book[n].methods)
        w.state.pool[0] = number
        collect(w, number)
        cards = OfferCards(w.book)
        assert describe(w, cards)["orders"][0]["methods"] == []
        w.state.position = w.book[number].dropoff.anchor
        told = describe(w, cards)["orders"][0]["methods"]
        assert told == (list(w.book[number].methods) if rules == "fair" else [])


def test_quirk_last_call_is_cut() -> None:
    for rules, seconds in (("original", 0.1), ("fair", 30.0)):
        assert world(rules, calls=1).step("WAIT(30)").seconds == seconds


def test_orders_are_limited_in_fair() -> None:
    for rules, count in (("original", 15), ("fair", 10)):
        w = world(rules)
        for _ in range(3):
            w.step(f"ACCEPT_ORDER({w.state.pool[:5]})")
        assert len(w.state.orders) == count
