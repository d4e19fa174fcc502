"""The bus: its timetable on a line small enough to do by hand, and on the reference's cities; riding it."""

from __future__ import annotations

import json

import pytest

from agentspec.envs.deliverybench.city.citymap import load_city
from agentspec.envs.deliverybench.world.bus import BusTimetable, first_tick
from agentspec.envs.deliverybench.world.rules import FAIR, ORIGINAL
from tests.envs.deliverybench.helpers import REFERENCE, do, ledger_holds, needs_reference, refuse, tiny, world

NAMES = ("bus_station 1", "bus_station 2")
STOPS = ((10_000.0, 0.0), (30_000.0, 0.0))
# path 0 m, stop 100 m, path 200 m, stop 300 m, path 400 m: all on a straight line.
POINTS = ((0.0, 0.0), STOPS[0], (20_000.0, 0.0), STOPS[1], (40_000.0, 0.0))


def test_first_stops() -> None:
    # At 10 m/s: 100 m in 10 s, then 360 s at the stop, 200 m in 20 s, and so on.
    bus = BusTimetable(NAMES, STOPS, POINTS, ORIGINAL)
    first, waiting, moving, second = (bus.phase(tick) for tick in (0, 100, 3700, 3900))
    assert first and not first.stopped and first.target == "bus_station 1" and first.until == 10.0
    assert waiting and waiting.stopped and waiting.stop == "bus_station 1" and waiting.tick == 100
    assert moving and not moving.stopped and moving.position == STOPS[0] and moving.until == 390.0
    assert second and second.stopped and second.stop == "bus_station 2"


def test_way_back() -> None:
    # Second stop from tick 3900 to 7500. The original then drives from there to the end of the path (100 m) and back to
    # the same stop (100 m): 20 s. The true line goes straight back to the first stop: 200 m, also 20 s.
    odd = BusTimetable(NAMES, STOPS, POINTS, ORIGINAL)
    true = BusTimetable(NAMES, STOPS, POINTS, FAIR)
    assert [odd.arrival("bus_station 2", 7500), odd.arrival("bus_station 1", 7500)] == [7700, 7700 + 3600 + 200]
    assert true.arrival("bus_station 1", 7500) == 7700
    phase = true.phase(7700)
    assert phase is not None and phase.direction == -1
    # And forth again: 360 s at the first stop, then 200 m.
    assert true.arrival("bus_station 2", 7700) == 7700 + 3600 + 200


def test_arrival_now_and_unknown_stop() -> None:
    bus = BusTimetable(NAMES, STOPS, POINTS, ORIGINAL)
    assert bus.arrival("bus_station 1", 150) == 150
    with pytest.raises(ValueError, match="expected one of bus_station 1"):
        bus.arrival("nowhere", 0)
    assert BusTimetable((), (), (), ORIGINAL).phase(0) is None


def test_first_tick_compares_without_slack() -> None:
    assert first_tick(5.0, 0, 10) == 50
    assert first_tick(5.0000001, 0, 10) == 51
    assert first_tick(5.0, 60, 10) == 60


@needs_reference
@pytest.mark.parametrize("path", sorted((REFERENCE / "compiled").glob("*.json")), ids=lambda path: path.stem)
def test_reference_timetable(path) -> None:  # type: ignore[no-untyped-def]
    line = load_city(REFERENCE / "maps" / path.stem).bus
    bus = BusTimetable(line.stop_names, line.stops, line.points, ORIGINAL)
    for event in json.loads(path.read_text())["bus"]["timeline"]:
        phase = bus.phase(round(event["t"] * 10))
        assert phase is not None
        assert (phase.tick, phase.stopped) == (round(event["t"] * 10), event["state"] == "stopped")
        assert (phase.stop or None, phase.direction) == (event["stop"], event["dir"])
        assert phase.position == pytest.approx((event["x"], event["y"]), abs=1e-3)
        if not phase.stopped:
            assert phase.until == pytest.approx(event["arrival"], abs=1e-5)


def test_boarding_errors_in_order() -> None:
    w = world()
    a, b = tiny().bus.stop_names[:2]
    refuse(w, f'BOARD_BUS("bus_1", "{b}")', "BB_NO_ID")
    refuse(w, 'BOARD_BUS(bus_id="bus_1")', "BB_NO_TARGET")
    refuse(w, f'BOARD_BUS(bus_id="bus_7", target_stop_id="{b}")', "BB_UNKNOWN_BUS")
    refuse(w, f'BOARD_BUS(bus_id="bus_1", target_stop_id="{b}")', "BB_NOT_AT_STOP")
    do(w, f"WAIT({w.timetable.arrival(a, 0) / 10 + 1})")
    phase = w.timetable.phase(w.state.tick)
    assert phase is not None and phase.stopped
    w.state.position = phase.position
    refuse(w, 'BOARD_BUS(bus_id="bus_1", target_stop_id="Main Street")', "BB_NOT_ON_ROUTE")
    refuse(w, f'BOARD_BUS(bus_id="bus_1", target_stop_id="{phase.stop}")', "BB_ALREADY_THERE")
    w.pay("purchases", -99.5)
    refuse(w, f'BOARD_BUS(bus_id="bus_1", target_stop_id="{b if phase.stop == a else a}")', "BB_FUNDS")


def test_ride() -> None:
    w = world("fair")
    a, b = w.timetable.names[:2]
    do(w, f"WAIT({w.timetable.arrival(a, 0) / 10})")
    w.state.position = w.timetable.stops[0]
    do(w, 'SWITCH("walk")')
    start = w.state.tick
    outcome = do(w, f'BOARD_BUS(bus_id="bus_1", target_stop_id="{b}")')
    assert w.state.tick == w.timetable.arrival(b, start) and outcome.seconds > 0
    assert w.state.position == pytest.approx(w.timetable.stops[1], abs=0.01)
    assert (w.state.mode, w.state.ledger["bus"]) == ("walk", -1.0)
    assert len(w.state.recent) >= 2 and ledger_holds(w)


def test_schedule_is_told() -> None:
    w = world()
    do(w, "VIEW_BUS_SCHEDULE()")
    notice = w.state.notices[-1]
    assert notice.kind == "schedule" and notice.data["stopped"] is False
    assert all(name in notice.text for name in w.timetable.names)
