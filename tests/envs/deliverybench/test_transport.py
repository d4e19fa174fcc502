"""Following a route in closed form: against the tick-by-tick definition, and by hand."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agentspec.envs.deliverybench.world.transport import Follower, heading, sent, ticks_until_empty, waypoints_of
from tests.envs.deliverybench.helpers import do, metres, off, refuse, stand, tiny, world

Point = tuple[float, float]


def tick_by_tick(
    start: Point, waypoints: list[Point], step: float, target: Point, limit: int
) -> tuple[int, bool, Point]:
    """The definition: each tick, pass waypoints within 5 m and step to the next; done within 5 m of the target."""
    (x, y), i, last = start, 0, len(waypoints) - 1
    for tick in range(1, limit + 1):
        while i < last and math.dist((x, y), waypoints[i]) <= 500.0:
            i += 1
        d = math.dist((x, y), waypoints[i])
        if i == last and d <= 136.6:
            return tick - 1, False, (x, y)
        x += (waypoints[i][0] - x) / d * step
        y += (waypoints[i][1] - y) / d * step
        if math.dist((x, y), target) <= 500.0:
            return tick, True, (x, y)
    return limit, False, (x, y)


def test_straight_line() -> None:
    # 100 m at 60 cm per tick: within 5 m after ceil(9500 / 60) = 159 ticks, at 9540 cm; creeps on to 10000 - 136.6.
    body = Follower((0.0, 0.0), [(10_000.0, 0.0)], 60.0, 500.0, 136.6)
    assert body.run((10_000.0, 0.0), 10_000) == (159, True)
    assert (body.x, body.y) == pytest.approx((9540.0, 0.0))
    # 460 - 136.6 = 323.4 cm left: 6 ticks, the last one shorter.
    assert body.settle(10_000) == 6
    assert (body.x, body.travelled) == pytest.approx((9863.4, 9863.4))


def test_corner_is_cut() -> None:
    # Towards (6000, 0): turns when within 5 m, after ceil(5500 / 60) = 92 ticks at x = 5520, then diagonally north.
    body = Follower((0.0, 0.0), [(6000.0, 0.0), (6000.0, 6000.0)], 60.0, 500.0, 136.6)
    body.run((6000.0, 6000.0), 93)
    length = math.hypot(480.0, 6000.0)
    assert (body.x, body.y) == pytest.approx((5520.0 + 60.0 * 480.0 / length, 60.0 * 6000.0 / length))


def test_limit_and_passing_target() -> None:
    body = Follower((0.0, 0.0), [(10_000.0, 0.0)], 60.0, 500.0, 136.6)
    assert body.run((10_000.0, 0.0), 10) == (10, False)
    assert body.x == pytest.approx(600.0)
    # The target lies beside the way: reached at x >= 5000 - sqrt(500^2 - 300^2) = 4600, ceil(4000 / 60) = 67 ticks on.
    assert body.run((5000.0, 300.0), 1000) == (67, True)
    assert body.settle(3) == 3


coordinate = st.integers(-60_000, 60_000).map(lambda n: n / 4)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=6),
    # Odd steps: with round ones both ways of counting may meet the 5 m exactly, and rounding decides.
    st.sampled_from([11.2537, 15.0041, 20.0062, 45.0113, 60.0171, 75.0209, 120.0283, 149.9761]),
    st.integers(1, 6000),
)
def test_closed_form_equals_ticks(points: list[Point], step: float, limit: int) -> None:
    start, waypoints = points[0], points[1:]
    target = waypoints[-1]
    if math.dist(start, target) <= 500.0:
        return
    body = Follower(start, waypoints, step, 500.0, 136.6)
    ticks, arrived = body.run(target, limit)
    expected = tick_by_tick(start, waypoints, step, target, limit)
    assert (ticks, arrived) == expected[:2]
    assert (body.x, body.y) == pytest.approx(expected[2], abs=1e-4)
    assert body.travelled == pytest.approx(ticks * step)


def test_ticks_until_empty() -> None:
    # 1 % at 0.024 % per tick: 41.67 -> the 42nd tick. Exactly 0.5 / 0.05 is 10 ticks, whatever rounding says.
    assert ticks_until_empty(1.0, 0.024) == 42
    assert ticks_until_empty(0.5, 0.05) == 10
    assert ticks_until_empty(0.3, 0.1) == 3
    assert ticks_until_empty(1.0, 0.0) is None


def test_heading_and_sent() -> None:
    assert [heading(1, 0), heading(0, 1), heading(-1, 0), heading(0, -1)] == pytest.approx([0, 90, 180, 270])
    assert sent((1.23456, -2.0)) == (1.23, -2.0)
    assert waypoints_of([(0.0, 0.0), (1.005, 2.0)]) == [sent((1.005, 2.0))]
    assert waypoints_of([(7.0, 7.0)]) == [(7.0, 7.0)]


@pytest.mark.parametrize("pace, factor", [("normal", 1.0), ("accel", 1.25), ("decel", 0.75), ("hop", 1.0)])
def test_what_a_move_costs(pace: str, factor: float) -> None:
    w = world("fair")
    target = tiny().pois_of("store")[0].anchor
    outcome = do(w, f'MOVE({metres(target)}, pace="{pace}")')
    used, battery = 100.0 - w.state.energy, 50.0 - w.state.scooter.battery
    # A scooter needs 0.01 % energy and 0.04 % battery a metre, both times the pace factor.
    assert battery == pytest.approx(4.0 * used)
    assert used / 0.01 / factor / outcome.seconds == pytest.approx(6.0 * factor, rel=0.01)
    assert math.dist(w.state.position, target) == pytest.approx(136.6, abs=0.8)  # the text rounds to 1 cm


def test_battery_runs_empty() -> None:
    # 1 % of battery is 25 m of riding: ceil(2500 / 60) = 42 ticks, 25.2 m walked, then the scooter is dragged.
    w = world()
    w.state.scooter.battery = 1.0
    outcome = refuse(w, f"MOVE({metres(far(w.state.position))})", "MV_DEPLETED")
    assert (w.state.mode, w.state.scooter.state, w.state.scooter.battery) == ("drag_scooter", "depleted", 0.0)
    assert outcome.seconds == 4.2 and 100.0 - w.state.energy == pytest.approx(0.252)
    assert w.recorder.interruptions["scooter_depleted"] == 1
    assert w.recorder.mode_ticks == {"e-scooter": 41, "drag_scooter": 1}


def far(start: Point) -> Point:
    """The place farthest from a point."""
    return max((poi.anchor for poi in tiny().pois), key=lambda p: math.dist(p, start))


@pytest.mark.parametrize("rules", ["original", "fair"])
def test_collapse_and_hospital(rules: str) -> None:
    w = world(rules)
    do(w, 'SWITCH("walk")')
    w.state.energy = 1.0
    outcome = refuse(w, f"MOVE({metres(far(w.state.position))})", "MV_COLLAPSED")
    # 1 % is 12.5 m on foot: ceil(1250 / 20) = 63 ticks, then 900 s in hospital and 5 dollars.
    assert outcome.seconds == pytest.approx(6.3 + 900.0, abs=0.11)
    assert (w.state.energy, w.state.balance, w.state.ledger["hospital"]) == (100.0, 95.0, -5.0)
    assert w.state.position == pytest.approx(tiny().pois_of("hospital")[0].anchor, abs=0.01)
    assert w.recorder.interruptions["hospital_rescue"] == 1 and w.recorder.idle["hospital"] == 900.0


def test_short_moves_and_turns() -> None:
    w = world()
    here = w.state.position
    assert do(w, f'MOVE({metres(off(here, 300.0))}, pace="accel")').seconds == 0.0
    assert (w.state.position, w.state.pace) == (here, "normal")
    do(w, 'TURN_AROUND(angle=90, direction="right")')
    do(w, "STEP_FORWARD()")
    assert w.state.position == pytest.approx(off(here, 0.0, 100.0), abs=1e-3)
    do(w, 'TURN_AROUND(angle=90, direction="left")')
    do(w, 'TURN_AROUND(direction="right")')
    assert w.state.yaw == pytest.approx(0.0)
    refuse(w, 'TURN_AROUND(direction="left")', "TA_BAD")
    refuse(w, 'TURN_AROUND(angle="much")', "PARSE_ARGS")  # told by the reader of answers, before it is a step's error
    refuse(w, "MOVE(1e9m, 0m)", "PARSE_ARGS")


def test_switching() -> None:
    w = world("fair")
    refuse(w, 'SWITCH("boat")', "SW_BAD_TARGET")
    refuse(w, "SWITCH()", "SW_EMPTY")
    refuse(w, 'SWITCH("car")', "SW_NO_CAR")
    here = w.state.position
    do(w, 'SWITCH("walk")')
    assert w.state.scooter.park == here
    w.state.position = off(here, 501.0)
    refuse(w, 'SWITCH("e-scooter")', "SW_NOT_NEAR_SCOOTER")
    w.state.position = off(here, 499.0)
    do(w, 'SWITCH("drag")')
    assert w.state.mode == "drag_scooter" and w.state.scooter.park is None
    w.state.scooter.battery = 0.0
    do(w, 'SWITCH("scooter")')
    assert (w.state.mode, w.state.scooter.state) == ("drag_scooter", "depleted")


def test_rented_car() -> None:
    w = world("fair")
    refuse(w, "RENT_CAR()", "RC_NOT_AT")
    refuse(w, "RETURN_CAR()", "RT_NOT_AT")
    here = stand(w, "car_rental")
    refuse(w, "RETURN_CAR()", "RT_NO_CAR")
    do(w, "RENT_CAR()")
    refuse(w, "RENT_CAR()", "RC_HAVE_CAR")
    assert w.state.mode == "car" and w.state.scooter.state == "parked"
    do(w, "WAIT(90)")
    assert w.state.balance == pytest.approx(100.0 - 1.5)
    do(w, 'SWITCH("walk")')
    w.state.position = off(here, 600.0)
    refuse(w, 'SWITCH("car")', "SW_NOT_NEAR_CAR")
    w.state.position = here
    do(w, 'SWITCH("car")')
    do(w, "RETURN_CAR()")
    assert w.state.mode == "walk" and w.state.car is None and w.recorder.rentals == [(0, 900)]


@pytest.mark.parametrize("rules, mode", [("original", "car"), ("fair", "walk")])
def test_rent_unpaid_while_driving(rules: str, mode: str) -> None:
    w = world(rules)
    stand(w, "car_rental")
    w.pay("purchases", -99.95)
    do(w, "RENT_CAR()")
    # 5 cents last 3 s; the move is interrupted one tick later.
    outcome = refuse(w, f"MOVE({metres(far(w.state.position))})", "MV_BLOCKED")
    assert outcome.seconds == pytest.approx(3.1)
    assert (w.state.mode, w.state.car, w.state.balance) == (mode, None, 0.0)
    assert w.recorder.interruptions["rent_insufficient"] == 1


def test_charging() -> None:
    w = world("fair")
    refuse(w, "CHARGE(80)", "CH_NO_STATION")
    here = stand(w, "charging_station")
    do(w, "CHARGE(80)")
    refuse(w, "CHARGE(90)", "CH_BUSY")
    assert w.state.mode == "walk" and w.state.scooter.state == "parked"
    do(w, "WAIT(60)")
    # 7.5 % a minute at 5 cents each.
    assert (w.state.scooter.battery, w.state.balance) == pytest.approx((57.5, 100.0 - 0.375))
    outcome = do(w, 'WAIT("charge_done")')
    assert outcome.seconds == pytest.approx(180.0) and w.state.scooter.battery == 80.0
    assert w.state.charging is None and w.state.balance == pytest.approx(98.5)
    w.state.position = off(here, 0.0, 499.0)
    do(w, "CHARGE(50)")
    assert w.state.charging is None
    do(w, 'SWITCH("e-scooter")')
    w.state.position = off(here, 5000.0)
    do(w, 'SWITCH("walk")')
    w.state.position = here
    refuse(w, "CHARGE(100)", "CH_NO_SCOOTER")


def test_charging_without_money() -> None:
    w = world("fair")
    stand(w, "charging_station")
    w.pay("purchases", -99.9)
    do(w, "CHARGE(100)")
    do(w, 'WAIT("charge_done")')
    # 10 cents buy 2 %.
    assert (w.state.scooter.battery, w.state.balance) == pytest.approx((52.0, 0.0), abs=1e-9)
    assert w.recorder.interruptions["charge_insufficient"] == 1
    assert w.recorder.charges[-1][-1] == "no_money"


def test_battery_pack() -> None:
    w = world("fair")
    refuse(w, "USE_BATTERY_PACK()", "BP_NONE")
    w.state.inventory["escooter_battery_pack"] = 2
    do(w, 'SWITCH("walk")')
    here = w.state.position
    w.state.position = off(here, 501.0)
    refuse(w, "USE_BATTERY_PACK()", "BP_NOT_NEAR")
    w.state.position = here
    do(w, "USE_BATTERY_PACK()")
    assert w.state.scooter.battery == 100.0 and w.state.scooter.state == "parked" and w.state.mode == "walk"
    do(w, 'SWITCH("drag")')
    do(w, "USE_BATTERY_PACK()")
    assert w.state.mode == "e-scooter"
