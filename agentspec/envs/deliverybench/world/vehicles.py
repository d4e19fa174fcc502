"""Vehicles: SWITCH, charging and the battery pack, the rented car, the bus."""

from __future__ import annotations

import math

from agentspec.envs.deliverybench.world.bus import BusTimetable
from agentspec.envs.deliverybench.world.clock import go_to_hospital, look, pass_time, stop_charging
from agentspec.envs.deliverybench.world.grammar import Refused, argument, number, short, unread
from agentspec.envs.deliverybench.world.moving import charge_way
from agentspec.envs.deliverybench.world.shift import Shift
from agentspec.envs.deliverybench.world.state import DEPLETED, PARKED, USABLE, Car, Charging
from agentspec.envs.deliverybench.world.transport import sent
from agentspec.types import Action

_TARGETS = {
    "walk": "walk",
    "e-scooter": "e-scooter",
    "scooter": "e-scooter",
    "escooter": "e-scooter",
    "car": "car",
    "drag_scooter": "drag_scooter",
    "drag": "drag_scooter",
}


def switch(world: Shift, action: Action) -> str:
    """SWITCH(to=): change the way of travelling.

    In the original the vehicle in use is parked *before* the request is checked, and a refusal leaves it parked while
    the mode stays (``Rules.ride_parked_scooter``).
    """
    wish = argument(action, 0, "to")
    if not isinstance(wish, str) or not wish.strip():
        raise unread(action, "say what to switch to", "SW_EMPTY")
    state = world.state
    target = _TARGETS.get(wish.strip().lower(), "")
    refusal = None if world.rules.ride_parked_scooter else _refusal(world, target, wish)
    if refusal is not None:
        raise refusal
    if state.mode == "car":
        world.park_car()
    if state.mode in ("e-scooter", "drag_scooter") and target != "drag_scooter":
        world.park_scooter()
    if world.rules.ride_parked_scooter:
        refusal = _refusal(world, target, wish)
        if refusal is not None:
            raise refusal
    _change(world, target)
    return f"switched to {wish.strip()}"


def _refusal(world: Shift, target: str, wish: str) -> Refused | None:
    """Why the switch cannot be made, or None."""
    state = world.state
    if not target:
        return Refused("SW_BAD_TARGET", f"cannot switch to {short(wish)}; use walk, e-scooter, car or drag_scooter")
    if target in ("e-scooter", "drag_scooter"):
        held = target == "drag_scooter" and state.mode in ("e-scooter", "drag_scooter")
        if not held and not world.near(state.scooter.park):
            where = _where(state.scooter.park)
            return Refused("SW_NOT_NEAR_SCOOTER", f"your scooter is not here{where}: go there first")
    if target == "car":
        if state.car is None:
            return Refused("SW_NO_CAR", "you have no car: rent one at a car rental first")
        if not world.near(state.car.park):
            return Refused("SW_NOT_NEAR_CAR", f"your car is not here{_where(state.car.park)}: go there first")
    return None


def _change(world: Shift, target: str) -> None:
    state = world.state
    if target == "car":
        assert state.car is not None
        state.car.state, state.car.park = USABLE, None
    if target in ("e-scooter", "drag_scooter"):
        world.unpark_scooter()
        if target == "e-scooter" or not world.rules.drag_keeps_charging:
            stop_charging(world, "interrupted")
        if target == "e-scooter" and state.scooter.state == DEPLETED:
            target = "drag_scooter"
    world.set_mode(target)


def _where(park: tuple[float, float] | None) -> str:
    return "" if park is None else f" but at ({park[0] / 100:.2f}m, {park[1] / 100:.2f}m)"


def charge(world: Shift, action: Action) -> str:
    """CHARGE(target_pct=100): plug the scooter in; it charges in the background and is paid per percent."""
    target = min(100.0, max(0.0, number(argument(action, 0, "target_pct"), action, "target_pct", 100.0)))
    state, rules = world.state, world.rules
    if state.charging is not None:
        raise Refused("CH_BUSY", f"the scooter is already charging to {state.charging.target:.0f} %")
    if world.city.near("charging_station", state.position, rules.nearby) is None:
        raise Refused("CH_NO_STATION", "there is no charging station within 5m: move to one first")
    riding = state.mode in ("e-scooter", "drag_scooter")
    if not riding and not (state.scooter.state == PARKED and world.near(state.scooter.park)):
        raise Refused("CH_NO_SCOOTER", f"your scooter is not here{_where(state.scooter.park)}")
    if riding:
        world.park_scooter()
        world.set_mode("walk")
    if target > state.scooter.battery:
        state.charging = Charging(state.tick, state.scooter.battery, target)
        world.recorder.prevention["early_charge"] += 1
        seconds = (target - state.scooter.battery) / rules.charge_per_min * 60.0
        world.recorder.be_idle("wait", seconds)
    return f"charging the scooter to {target:.0f} %"


def use_battery_pack(world: Shift, action: Action) -> str:
    """USE_BATTERY_PACK(): a full battery for the scooter, in hand or parked within reach."""
    state, rules = world.state, world.rules
    if state.inventory.get("escooter_battery_pack", 0) <= 0:
        raise Refused("BP_NONE", "you have no battery pack: buy an escooter_battery_pack at a store")
    scooter = state.scooter
    if scooter.state == PARKED and not world.near(scooter.park):
        raise Refused("BP_NOT_NEAR", f"your scooter is not here{_where(scooter.park)}: go there first")
    state.inventory["escooter_battery_pack"] -= 1
    state.notices.clear()
    scooter.battery = rules.pack_battery
    if scooter.state != PARKED:
        scooter.state = USABLE
    if state.mode == "drag_scooter":
        world.set_mode("e-scooter")
    world.recorder.prevention["use_scooter_battery_pack"] += 1
    return "used a battery pack"


def rent_car(world: Shift, action: Action) -> str:
    """RENT_CAR(): take a car at a rental; billed by the minute until it is returned."""
    state = world.state
    if world.city.near("car_rental", state.position, world.rules.nearby) is None:
        raise Refused("RC_NOT_AT", "there is no car rental within 5m: move to one first")
    if state.car is not None:
        raise Refused("RC_HAVE_CAR", "you already rent a car: return it first")
    if state.mode in ("e-scooter", "drag_scooter"):
        world.park_scooter()
    state.car = Car(state.tick)
    world.set_mode("car")
    return "rented a car"


def return_car(world: Shift, action: Action) -> str:
    """RETURN_CAR(): end the contract at any rental; unless the quirk allows otherwise, the car must be here."""
    state = world.state
    if world.city.near("car_rental", state.position, world.rules.nearby) is None:
        raise Refused("RT_NOT_AT", "there is no car rental within 5m: move to one first")
    car = state.car
    if car is None:
        raise Refused("RT_NO_CAR", "you have no rented car")
    if not world.rules.return_absent_car and car.state == PARKED and not world.near(car.park):
        raise Refused("RT_NOT_HERE", f"the car is not here{_where(car.park)}: drive it here first")
    world.recorder.rentals.append((car.since, state.tick))
    state.car = None
    if state.mode == "car":
        world.set_mode("walk")
    return "returned the car"


def board_bus(world: Shift, action: Action) -> str:
    """BOARD_BUS(bus_id=, target_stop_id=): ride from the stop where the bus stands to another one."""
    state, rules = world.state, world.rules
    bus, stop = action.kwargs.get("bus_id"), action.kwargs.get("target_stop_id")
    timetable = world.timetable
    if not bus:
        raise Refused("BB_NO_ID", f'name the bus: BOARD_BUS(bus_id="{BusTimetable.bus_id}", target_stop_id="...")')
    if not stop:
        raise Refused("BB_NO_TARGET", "name the stop to ride to as target_stop_id")
    phase = timetable.phase(state.tick)
    if phase is None or bus != BusTimetable.bus_id:
        raise Refused("BB_UNKNOWN_BUS", f"there is no bus {short(bus)}; see VIEW_BUS_SCHEDULE()")
    if not phase.stopped or math.dist(phase.position, state.position) > rules.bus_tolerance:
        raise Refused("BB_NOT_AT_STOP", "the bus does not stand within 10m of you; see VIEW_BUS_SCHEDULE()")
    if stop not in timetable.names:
        raise Refused("BB_NOT_ON_ROUTE", f"{short(stop)} is not on the line; stops: {', '.join(timetable.names)}")
    if stop == phase.stop:
        raise Refused("BB_ALREADY_THERE", f"the bus stands at {stop} already: choose another stop")
    if state.balance < rules.bus_fare:
        raise Refused("BB_FUNDS", f"the fare is {rules.bus_fare:.2f}, you have {state.balance:.2f}")
    state.notices.clear()
    world.pay("bus", -rules.bus_fare)
    if not rules.bus_carries_vehicle:
        world.park_vehicle()
    world.remember(f"boarded {bus} towards {stop}")
    _ride(world, str(stop))
    return f"arrived by bus at {stop}"


def _ride(world: Shift, stop: str) -> None:
    state, rules = world.state, world.rules
    before = state.mode
    world.set_mode("bus")
    state.riding_to = stop
    pass_time(world, world.timetable.arrival(stop, state.tick))
    state.riding_to = ""
    phase = world.timetable.phase(state.tick)
    assert phase is not None
    metres = math.dist(state.position, phase.position) / 100.0
    state.position = sent(phase.position)
    if rules.bus_ride_costs_walking:
        world.set_mode(before)
        exhausted, _ = charge_way(world, metres)
    else:
        exhausted, _ = charge_way(world, metres)
        world.set_mode(before)
    if exhausted:
        go_to_hospital(world)


def view_bus_schedule(world: Shift, action: Action) -> str:
    """VIEW_BUS_SCHEDULE(): the stops of the line, and what the bus does now."""
    state, rules = world.state, world.rules
    look(world, "schedule", "this city has no bus")
    phase = world.timetable.phase(state.tick)
    if phase is None:
        return "viewed the bus schedule"
    left = max(0.0, phase.until - state.tick / rules.ticks_per_second)
    doing = f"stands at {phase.stop} for {left:.0f}s more"
    if not phase.stopped:
        doing = f"reaches {phase.target} in {left:.0f}s"
    line = " - ".join(timetable_line(world))
    text = f"{BusTimetable.bus_id} {doing}. Line: {line}; it waits {rules.bus_dwell:.0f}s at each stop."
    facts = {"stopped": phase.stopped, "stop": phase.stop, "target": phase.target, "seconds": left}
    world.notify("schedule", text, facts)
    return "viewed the bus schedule"


def timetable_line(world: Shift) -> list[str]:
    """The stops in order with their positions in metres."""
    stops = zip(world.timetable.names, world.timetable.stops, strict=True)
    return [f"{name} ({x / 100:.2f}m, {y / 100:.2f}m)" for name, (x, y) in stops]
