"""Whole-world behaviour: the clock, services, the end of an episode, errors, and the report."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agentspec.envs.deliverybench.world.engine import HANDLERS, World
from agentspec.envs.deliverybench.world.grammar import SOCIAL, advertised, schema_for
from agentspec.envs.deliverybench.world.rules import FAIR, ORIGINAL
from agentspec.types import Action
from tests.envs.deliverybench.fuzz import sensible_text
from tests.envs.deliverybench.helpers import collect, do, ledger_holds, metres, refuse, stand, tiny, world


def test_every_action_of_the_schema_is_handled_and_its_example_parses() -> None:
    w = world("fair")
    schema = schema_for(FAIR)
    assert set(schema.actions) == set(HANDLERS)
    assert set(schema.aliases.values()) <= set(HANDLERS)
    for spec in schema.actions.values():
        outcome = w.step(spec.example.split(" or ")[0])
        assert not outcome.code.startswith("PARSE_"), (spec.example, outcome.message)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"rules": "kind"}, "expected one of original, fair"),
        ({"shift_hours": 0.0}, "positive number of hours"),
        ({"shift_hours": math.nan}, "positive number of hours"),
        ({"max_calls": 0}, "at least 1"),
    ],
)
def test_bad_arguments(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        World(tiny(), **arguments)  # type: ignore[arg-type]


def test_start() -> None:
    w = world("fair")
    state = w.state
    assert (state.position, state.mode, state.energy, state.balance) == ((-1.2, 0.8), "e-scooter", 100.0, 100.0)
    assert (state.scooter.battery, state.pool, state.tick, w.seconds) == (50.0, list(range(10)), 0, 0.0)


@pytest.mark.parametrize(
    "text, seconds",
    [
        ("WAIT(60)", 60.0),
        ("WAIT(seconds=0.05)", 0.1),
        ('WAIT("2.5")', 2.5),
        ("WAIT(-5)", 0.0),
        ("WAIT(duration_s=7)", 7.0),
    ],
)
def test_waiting(text: str, seconds: float) -> None:
    assert do(world("fair"), text).seconds == seconds


def test_wait_nonsense() -> None:
    w = world("fair")
    for text in ("WAIT()", 'WAIT("soon")', "WAIT([1])", "WAIT(1e999)", 'WAIT(until="dawn")'):
        refuse(w, text, "PARSE_ARGS")


def test_resting() -> None:
    w = world("fair")
    refuse(w, "REST(100)", "RE_NO_AREA")
    stand(w, "rest_area")
    w.state.energy = 50.0
    # 15 % at 7.5 % a minute.
    assert do(w, "REST(65)").seconds == 120.0 and w.state.energy == 65.0
    assert do(w, "REST(60)").seconds == 0.0
    assert do(w, "REST()").seconds == 280.0 and w.state.energy == 100.0
    assert w.recorder.prevention["early_rest"] == 2


def test_shopping() -> None:
    w = world("fair")
    refuse(w, 'BUY("ice_pack")', "BUY_NO_STORE")
    stand(w, "store")
    refuse(w, "BUY()", "BUY_EMPTY")
    refuse(w, 'BUY(item_id="ice_pack", qty=0)', "BUY_QTY")
    refuse(w, 'BUY(items="ice_pack")', "BUY_BAD_ITEMS")
    refuse(w, 'BUY(items=[{"qty": 2}])', "BUY_EMPTY")
    refuse(w, 'BUY(item="magic_wand")', "BUY_ALL_FAILED")
    refuse(w, 'BUY(item_id="energy_drink", qty=17)', "BUY_ALL_FAILED")
    do(w, 'BUY(items=[{"item_id": "ice_pack", "qty": 1}, {"name": "ice_pack"}, {"item": "nope", "qty": 1}])')
    do(w, 'BUY("energy_drink", 2)')
    assert w.state.inventory == {"ice_pack": 2, "energy_drink": 2} and w.state.balance == 82.0
    # Down to exactly nothing: 7 packs of 10 dollars, 4 of 3.
    do(w, 'BUY(items=[{"item_id": "escooter_battery_pack", "qty": 7}, {"item_id": "heat_pack", "qty": 4}])')
    assert w.state.balance == 0.0
    refuse(w, 'BUY("ice_pack")', "BUY_ALL_FAILED")


def test_energy_drink() -> None:
    w = world("fair")
    refuse(w, "USE_ENERGY_DRINK()", "ED_FULL")
    w.state.energy = 70.0
    refuse(w, "USE_ENERGY_DRINK()", "ED_NONE")
    w.state.inventory["energy_drink"] = 1
    do(w, "USE_ENERGY_DRINK()")
    assert w.state.energy == 100.0


def test_drop_off_errors_in_order() -> None:
    w = world("fair")
    refuse(w, 'DROP_OFF(method="knock")', "PARSE_ARGS")
    refuse(w, 'DROP_OFF("one", "knock")', "PARSE_ARGS")
    refuse(w, "DROP_OFF(1)", "DO_NO_METHOD")
    refuse(w, 'DROP_OFF(1, "throw")', "DO_BAD_METHOD")
    refuse(w, 'DROP_OFF(1, "knock")', "DO_UNKNOWN")
    do(w, "ACCEPT_ORDER(1)")
    refuse(w, 'DROP_OFF(1, "knock")', "DO_NOT_PICKED")
    do(w, "WAIT(420)")
    w.state.position = w.state.orders[1].offer.pickup.anchor
    do(w, "PICKUP(orders=[1])")
    refuse(w, 'DROP_OFF(1, "knock")', "DO_NOT_AT_DOOR")
    refuse(w, 'DROP_OFF(1, "hand_to_customer")', "DO_NOT_AT_CUSTOMER")


def test_hand_over() -> None:
    w = world("fair", seed=3)
    number = next(n for n in range(200) if w.book[n].handoff is not None)
    w.state.pool[0] = number
    collect(w, number)
    offer = w.state.orders[number].offer
    assert offer.handoff is not None
    x, y = offer.handoff
    w.state.position = (x + 400.0, y)
    do(w, f'DROP_OFF({number}, "hand_to_customer")')
    assert w.state.settlements[0].method_star == 5


def test_a_whole_delivery_pays() -> None:
    w = world("fair")
    collect(w, 1)
    order = w.state.orders[1]
    count = len(order.pending)
    clauses = "; ".join(f"{i + 1} -> {'ABCD'[i]}" for i in range(count))
    do(w, f'PLACE_FOOD_IN_BAG("{clauses}")')
    do(w, f"MOVE({metres(order.offer.dropoff.anchor)})")
    outcome = do(w, 'DROP_OFF(1, "leave_at_door")')
    settlement = outcome.settlements[0]
    assert w.state.balance == pytest.approx(100.0 + settlement.paid) and w.state.ledger["orders"] == settlement.paid
    assert settlement.duration == pytest.approx(w.seconds) and not w.state.orders
    assert w.evaluation()["hourly_profit"] == pytest.approx(settlement.paid / 2.0)


@pytest.mark.parametrize("text", ["WAIT(1e6)", "REST(100)", 'WAIT("charge_done")'])
def test_the_shift_ends_during_an_action(text: str) -> None:
    w = world("original", hours=0.05)
    stand(w, "rest_area")
    w.state.energy = 10.0
    outcome = w.step(text)
    assert (outcome.ok, outcome.ended, outcome.reason, outcome.seconds) == (None, True, "shift", 180.0)
    # 179.9 s of rest at 0.125 % a second.
    assert w.state.energy == pytest.approx(10.0 + 22.4875 if text.startswith("REST") else 10.0)
    assert refuse(w, "VIEW_ORDERS()", "ENDED").ended
    assert w.summary()["meta"]["reason"] == "shift"


def test_the_shift_ends_on_the_way() -> None:
    w = world("original", hours=0.001)
    target = max((p.anchor for p in tiny().pois), key=lambda p: math.hypot(*p))
    outcome = w.step(f"MOVE({metres(target)})")
    # 3.6 s at 6 m/s.
    assert outcome.ok is None and outcome.seconds == pytest.approx(3.6)
    assert 100.0 - w.state.energy == pytest.approx(0.216)


def test_charging_and_rent_stop_at_the_end() -> None:
    w = world("original", hours=0.05)
    stand(w, "charging_station")
    do(w, "CHARGE(100)")
    stand(w, "car_rental")
    do(w, "RENT_CAR()")
    assert w.step("WAIT(1000)").ended
    assert w.state.charging is None and w.recorder.rentals == [(0, 1800)]
    # 179.9 s each: the last tick moves nothing but the clock.
    assert w.state.scooter.battery == pytest.approx(50.0 + 179.9 * 0.125)
    assert w.state.ledger["rental"] == pytest.approx(-179.9 / 60.0) and ledger_holds(w)


@pytest.mark.parametrize("rules, ok, seconds", [("original", None, 0.1), ("fair", True, 30.0)])
def test_call_limit(rules: str, ok: bool | None, seconds: float) -> None:
    w = world(rules, calls=3)
    do(w, "VIEW_ORDERS()")
    refuse(w, "nonsense", "PARSE_NOT_CALL")
    outcome = w.step("WAIT(30)")
    assert (outcome.ok, outcome.ended, outcome.reason, outcome.seconds) == (ok, True, "calls", seconds)


def test_errors_and_recent_actions() -> None:
    w = world("fair")
    outcome = refuse(w, "REST(100)", "RE_NO_AREA")
    assert outcome.message in w.state.error and w.state.error.startswith("tried REST(100)")
    for _ in range(7):
        do(w, "VIEW_ORDERS()")
    assert w.state.error == "" and len(w.state.recent) == 5
    assert [notice.kind for notice in w.state.notices] == ["orders"]
    refuse(w, "FLY(10)", "PARSE_UNKNOWN")
    assert "FLY" in w.state.error


def test_parsed_actions_are_taken_as_well() -> None:
    w = world("fair")
    assert w.step(Action("WAIT", (5,))).seconds == 5.0
    assert w.step(Action("DANCE")).code == "PARSE_UNKNOWN"


def test_social_actions_with_one_courier() -> None:
    w = world("fair")
    do(w, 'SAY("hello")')
    refuse(w, 'SAY("")', "SAY_EMPTY")
    refuse(w, 'SAY("hello", to="agent 7")', "SAY_UNKNOWN_AGENT")
    do(w, "VIEW_HELP_BOARD()")
    do(w, 'POST_HELP(kind="help_buy")')
    refuse(w, "POST_HELP()", "HELP_KIND")
    refuse(w, "ACCEPT_HELP(1)", "HELP_ALONE")


def test_an_own_request_for_help_can_be_changed() -> None:
    w = world("original")
    do(w, 'POST_HELP(kind="HELP_DELIVERY", order_id=3, bounty=2)')
    do(w, 'POST_HELP(kind="HELP_BUY")')
    do(w, "EDIT_HELP(req_id=1, new_bounty=5)")
    do(w, "EDIT_HELP(req_id=2, new_ttl=600)")
    assert [(r.id, r.kind, r.bounty, r.seconds) for r in w.state.requests] == [
        (1, "HELP_DELIVERY", 5.0, None),
        (2, "HELP_BUY", 0.0, 600.0),
    ]
    refuse(w, "EDIT_HELP(req_id=3, new_bounty=5)", "HELP_UNKNOWN")
    refuse(w, "EDIT_HELP(req_id=1)", "HELP_NO_CHANGE")
    refuse(w, "EDIT_HELP(req_id=1, new_bounty=-1)", "PARSE_ARGS")
    blob = w.snapshot()
    do(w, "EDIT_HELP(1, new_bounty=9)")
    w.restore(blob)
    assert w.state.requests[0].bounty == 5.0 and w.state.balance == 100.0


def test_social_actions_are_not_advertised_to_a_lone_courier_but_work() -> None:
    schema = world("fair").schema
    shown = advertised(schema)
    assert set(schema.actions) - set(shown.actions) == set(SOCIAL) and "SAY" in SOCIAL
    assert {"MOVE", "DROP_OFF", "BOARD_BUS"} <= set(shown.actions)


def test_worlds_of_a_city_share_nothing_that_changes() -> None:
    one, two = world("fair"), world("fair")
    untouched = two.snapshot()
    rng = random.Random(0)
    for _ in range(100):
        one.step(sensible_text(rng, tiny(), one.state))
    assert two.snapshot() == untouched and one.book is two.book


def test_evaluation_by_hand() -> None:
    w = world("fair", hours=2.0)
    assert w.evaluation()["hourly_profit"] == 0.0 and w.evaluation()["mean_stars"] is None
    do(w, "ACCEPT_ORDER(1)")
    do(w, "WAIT(3600)")
    w.pay("purchases", -20.0)
    figures = w.evaluation()
    # 20 dollars spent in a shift of two hours; one order open and overdue; an hour waited of an hour worked.
    assert figures["hourly_profit"] == -10.0 and figures["hourly_profit_active"] == -20.0
    assert figures["expense_per_hour"] == 10.0
    assert (figures["on_time_rate"], figures["effective_time_ratio"]) == (0.0, 0.0)
    assert figures["time_utilisation"] == pytest.approx(w.state.orders[1].offer.limit / 3600.0)
    assert figures["pick_quality"] == w.state.orders[1].pick_score
    assert w.summary()["orders"]["open_overdue"] == 1


def test_bankruptcy_skips_a_bag_tick_in_the_original() -> None:
    w = world("original")
    w.state.inventory["ice_pack"] = 1
    do(w, "USE_ICE_PACK('A')")
    stand(w, "car_rental")
    do(w, "RENT_CAR()")
    w.pay("purchases", -99.95)
    do(w, "WAIT(10)")
    assert w.state.error == ""
    twin = world("original")
    twin.state.inventory["ice_pack"] = 1
    do(twin, "USE_ICE_PACK('A')")
    do(twin, "WAIT(9.9)")
    assert [i.temp for i in w.look().bag.items()] == pytest.approx([i.temp for i in twin.look().bag.items()], abs=1e-12)


def test_original_spawn_rules() -> None:
    assert ORIGINAL.spawn == FAIR.spawn == (-1.2, 0.8)


def tick_by_tick(
    balance: float, battery: float, target: float, rent: bool, ticks: int
) -> tuple[float, float, int, int]:
    """The definition of charging (7.5 % a minute at 5 cents each) and rent (a dollar a minute), charging first.

    Returns balance, battery, and the ticks at which charging and rent stopped (0 if they did not).
    """
    charging, charged, unpaid = target > battery, 0, 0
    for tick in range(1, ticks + 1):
        if charging:
            step = min(0.0125, target - battery)
            bought = min(step, balance / 0.05)
            battery, balance = battery + bought, balance - bought * 0.05
            if bought < step - 1e-9 or battery >= target - 1e-9:
                charging, charged = False, tick
        if rent:
            balance -= 1.0 / 600.0
            if balance <= 1e-9:
                balance, rent, unpaid = 0.0, False, tick
    return balance, battery, charged, unpaid


@settings(max_examples=150, deadline=None)
@given(
    st.floats(0.001, 4.0),
    st.floats(0.0, 99.0),
    st.floats(1.0, 100.0),
    st.booleans(),
    st.lists(st.integers(1, 900), min_size=1, max_size=4),
)
def test_money_runs_as_tick_by_tick(
    balance: float, battery: float, target: float, rent: bool, waits: list[int]
) -> None:
    w = world("fair")
    stand(w, "charging_station")
    w.state.scooter.battery = battery
    w.pay("purchases", balance - 100.0)
    do(w, f"CHARGE({target})")
    if rent:
        stand(w, "car_rental")
        do(w, "RENT_CAR()")
    for ticks in waits:
        do(w, f"WAIT({ticks / 10})")
    money, level, charged, unpaid = tick_by_tick(
        w.rules.initial_balance - 100.0 + balance, battery, target, rent, sum(waits)
    )
    assert w.state.balance == pytest.approx(money, abs=0.002)
    assert w.state.scooter.battery == pytest.approx(level, abs=0.013)
    assert (w.state.charging is None) == (bool(charged) or target <= battery)
    assert (w.state.car is None) == (bool(unpaid) or not rent)
    if charged:
        assert w.recorder.charges[0][1] == pytest.approx(charged, abs=1)
    if unpaid:
        assert w.recorder.rentals[0][1] == pytest.approx(unpaid, abs=1)
    assert ledger_holds(w)
