"""Passing time: everything that happens by itself while the courier moves, waits, rests or rides.

Simulated time advances on a grid of 0.1 s, but nothing here loops over it. Between two events all quantities are linear
in time (battery while charging, rent, the clock of every order), so the clock jumps from event to event: the end of the
shift, the end of a charging session, unpaid rent, the end of what the courier is doing. Order within one tick follows
the original: end of shift first (then nothing else happens), then charging, then rent.
"""

from __future__ import annotations

import math

from agentspec.envs.deliverybench.world.bus import first_tick
from agentspec.envs.deliverybench.world.grammar import Refused
from agentspec.envs.deliverybench.world.shift import Shift
from agentspec.envs.deliverybench.world.state import PARKED, Notice
from agentspec.envs.deliverybench.world.transport import sent

_SLACK = 1e-9
NEVER = 1 << 60


class ShiftOver(Exception):  # noqa: N818 - it is an event, not an error
    """The shift ended during an action: the action gets no result."""


def pass_time(world: Shift, end: int, *, charge_ends: bool = False) -> bool:
    """Advance to tick ``end``. With ``charge_ends`` stop when a charging session ends; returns whether that happened.

    Raises:
        ShiftOver: the shift ended first (the world stands at that tick).
    """
    state = world.state
    while state.tick < end:
        if state.charging is None and state.car is None and state.interrupt_at is None:
            if end < world.last_tick:
                _count(world, end)
                return False
            _finish(world)
        charge_end = _charging_ends(world)
        unpaid = _rent_unpaid(world)
        interrupt = NEVER if state.interrupt_at is None else state.interrupt_at
        tick = min(end, charge_end, unpaid, interrupt, world.last_tick)
        if tick == world.last_tick:
            _accrue(world, tick - 1)
            _finish(world)
        _accrue(world, tick, charging=tick != charge_end)
        if tick == interrupt:
            state.interrupt_at = None
            if world.rules.ghost_car:
                state.error = "movement blocked: your rented car was taken back"
        charged = tick == charge_end
        if charged:
            _end_charge_step(world, tick)
        if tick == unpaid:
            _take_car_back(world, tick)
        if charged and charge_ends:
            return True
    return False


def look(world: Shift, kind: str, text: str) -> None:
    """Show a notice. Looking once takes no time; looking again at what is shown takes ``Rules.look_seconds``, unless
    the rules let it pass (``free_looks``): otherwise an agent could look for ever and the shift would never end.

    Raises:
        ShiftOver: the shift ended meanwhile.
    """
    shown = any(notice.kind == kind for notice in world.state.notices)
    if shown and not world.rules.free_looks:
        pass_time(world, world.state.tick + math.ceil(world.rules.look_seconds * world.rules.ticks_per_second))
    world.notify(kind, text)


def interruption(world: Shift) -> int:
    """The tick at which a move under way would be interrupted because the rent cannot be paid (far off if never)."""
    state = world.state
    if state.interrupt_at is not None:
        return state.interrupt_at
    if state.car is None:
        return NEVER
    charge_end = _charging_ends(world)
    unpaid = _rent_unpaid(world)
    if charge_end < unpaid:
        # After the session the balance falls more slowly.
        left = state.balance - (charge_end - state.tick) * (_charge_cost(world) + _rent(world))
        unpaid = charge_end + max(1, math.ceil(left / _rent(world) - _SLACK))
    return unpaid + 1


def stop_charging(world: Shift, reason: str) -> None:
    """End and record the charging session, if any. ``reason``: finished, interrupted, no_money or ended."""
    state = world.state
    session = state.charging
    if session is None:
        return
    state.charging = None
    last = state.scooter.battery
    world.recorder.charges.append((session.since, state.tick, session.first, last, session.cost, reason))
    texts = {
        "finished": f"charging finished at {last:.0f} %",
        "no_money": f"charging stopped at {last:.0f} %: no money left",
        "interrupted": f"charging interrupted at {last:.0f} %: the scooter was taken away",
        "ended": f"charging stopped at {last:.0f} %: the shift is over",
    }
    state.notices.append(Notice("charging", texts[reason], {"battery": last, "reason": reason}))


def end_episode(world: Shift, reason: str) -> None:
    """End the episode: rental and charging are closed. ``reason``: "shift" or "calls"."""
    state = world.state
    state.reason = reason
    stop_charging(world, "ended")
    if state.car is not None:
        world.recorder.rentals.append((state.car.since, state.tick))


def go_to_hospital(world: Shift) -> None:
    """Energy is gone: pay the fee, be carried to the nearest hospital, and stay there.

    The vehicle in use comes along, and a scooter is drained by the way (``Rules.hospital_carries_vehicle``), or is left
    where it stands.

    Raises:
        ShiftOver: the shift ends during the stay.
    """
    state, rules = world.state, world.rules
    fee = min(rules.hospital_fee, state.balance)
    world.pay("hospital", -fee)
    world.recorder.hospital.append((state.tick, fee))
    world.recorder.interruptions["hospital_rescue"] += 1
    world.recorder.be_idle("hospital", rules.hospital_seconds)
    found = world.city.nearest("hospital", state.position)
    where = state.position if found is None else sent(found[0].anchor)
    if rules.hospital_carries_vehicle:
        jump = math.dist(state.position, where)
        if state.mode == "e-scooter" and world.drain_battery(jump / 100.0):
            world.deplete()
    else:
        world.park_vehicle()
    state.position = where
    state.hospital_until = first_tick(state.tick / rules.ticks_per_second + rules.hospital_seconds, state.tick + 1, 10)
    pass_time(world, state.hospital_until)
    state.hospital_until = None
    state.energy = rules.energy_max
    text = f"you collapsed and were taken to hospital; fee {fee:.2f}, you are rested again"
    state.notices.append(Notice("hospital", text, {"fee": fee}))


def _count(world: Shift, tick: int) -> None:
    state = world.state
    world.recorder.mode_ticks[state.mode] += tick - state.tick
    state.tick = tick


def _finish(world: Shift) -> None:
    """The last tick of the shift, in which only the clock moves."""
    bag, tick = world.state.bag, world.last_tick
    bag.advance(tick - 1)
    bag.tick = max(bag.tick, tick)
    _count(world, tick)
    end_episode(world, "calls" if world.last_tick < world.shift_ticks else "shift")
    raise ShiftOver


def _charge_step(world: Shift) -> float:
    return world.rules.charge_per_min / 60.0 / world.rules.ticks_per_second


def _charge_cost(world: Shift) -> float:
    return _charge_step(world) * world.rules.charge_price


def _rent(world: Shift) -> float:
    return world.rules.rental_per_min / 60.0 / world.rules.ticks_per_second


def _charging_ends(world: Shift) -> int:
    """The tick at which the session ends: target reached, money gone, or scooter moved away (the next tick)."""
    state = world.state
    session = state.charging
    if session is None:
        return NEVER
    if state.scooter.state != PARKED:
        return state.tick + 1
    step, cost = _charge_step(world), _charge_cost(world)
    full = max(1, math.ceil((session.target - state.scooter.battery) / step - _SLACK))
    if cost > 0.0:
        rent = 0.0 if state.car is None else _rent(world)
        affordable = math.floor((state.balance - cost) / (cost + rent) + _SLACK) + 1
        full = min(full, max(0, affordable) + 1)
    return state.tick + full


def _rent_unpaid(world: Shift) -> int:
    """The tick at which rent (with charging as it goes on now) would bring the balance to 0 or less."""
    state = world.state
    if state.car is None:
        return NEVER
    per_tick = _rent(world)
    if per_tick <= 0.0:
        return NEVER
    if state.charging is not None and state.scooter.state == PARKED:
        per_tick += _charge_cost(world)
    return state.tick + max(1, math.ceil(state.balance / per_tick - _SLACK))


def _accrue(world: Shift, tick: int, charging: bool = True) -> None:
    """Let linear quantities run to ``tick``; without ``charging`` the session's last step is left out."""
    state = world.state
    ticks = tick - state.tick
    if ticks <= 0:
        return
    session = state.charging
    if session is not None:
        n = ticks if charging else ticks - 1
        if n > 0:
            _charge(world, n * _charge_step(world))
    if state.car is not None:
        world.pay("rental", -min(ticks * _rent(world), state.balance))
    _count(world, tick)


def _charge(world: Shift, percent: float) -> None:
    session = world.state.charging
    assert session is not None
    cost = percent * world.rules.charge_price
    world.state.scooter.battery += percent
    session.cost += cost
    world.pay("charging", -cost)


def _end_charge_step(world: Shift, tick: int) -> None:
    """The last tick of a session: reach the target exactly, or spend what is left."""
    state = world.state
    session = state.charging
    assert session is not None
    if state.scooter.state != PARKED:
        stop_charging(world, "interrupted")
        return
    missing = session.target - state.scooter.battery
    if missing <= 0.0:
        stop_charging(world, "finished")
        return
    price = world.rules.charge_price
    affordable = missing if price <= 0.0 else max(0.0, state.balance / price)
    if missing <= _charge_step(world) * (1.0 + 1e-6) and missing <= affordable + _SLACK:
        _charge(world, min(missing, affordable))
        state.scooter.battery = session.target
        stop_charging(world, "finished")
        return
    _charge(world, min(affordable, _charge_step(world)))
    world.recorder.interruptions["charge_insufficient"] += 1
    stop_charging(world, "no_money")


def _take_car_back(world: Shift, tick: int) -> None:
    """Rent cannot be paid: the contract ends with an empty balance."""
    state, rules = world.state, world.rules
    car = state.car
    assert car is not None
    had_money = state.balance > 0.0 or state.tick > car.since + 1
    world.pay("rental", -state.balance)
    state.balance = 0.0
    state.car = None
    world.recorder.rentals.append((car.since, tick))
    world.recorder.interruptions["rent_insufficient"] += 1
    state.notices.append(Notice("rental", "your money is gone: the rented car was taken back", {}))
    state.interrupt_at = tick + 1
    if rules.ghost_car:
        if had_money:
            # The original fails inside this tick, so the bag misses it.
            state.bag.advance(tick - 1)
            state.bag.tick = tick
    elif state.mode == "car":
        world.set_mode("walk")


def blocked() -> Refused:
    """The refusal of a move that was interrupted for unpaid rent."""
    return Refused("MV_BLOCKED", "the move was interrupted: your money is gone and the rented car was taken back")
