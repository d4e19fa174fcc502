"""MOVE, STEP_FORWARD and TURN_AROUND, and what travelling costs in energy and battery."""

from __future__ import annotations

import math
from itertools import pairwise

from agentspec.envs.deliverybench.world.clock import blocked, go_to_hospital, interruption, pass_time
from agentspec.envs.deliverybench.world.grammar import (
    MAX_COORDINATE,
    MAX_INTEGER,
    Refused,
    argument,
    number,
    short,
    unread,
)
from agentspec.envs.deliverybench.world.packing import suggestion
from agentspec.envs.deliverybench.world.shift import Shift
from agentspec.envs.deliverybench.world.state import Point
from agentspec.envs.deliverybench.world.transport import Follower, heading, ticks_until_empty, waypoints_of
from agentspec.types import Action

_UNLIMITED = 1 << 60


class Collapsed(Refused):
    """A move that ended in hospital."""

    def __init__(self) -> None:
        super().__init__("MV_COLLAPSED", "you ran out of energy on the way and were taken to hospital", silent=True)


def move(world: Shift, action: Action) -> str:
    """MOVE(x, y, pace=): travel to a point (cm) in the current mode."""
    state, rules = world.state, world.rules
    target = _target(action, rules.bare_numbers_are_cm)
    pace = argument(action, 2, "pace")
    pace = pace.strip().lower() if isinstance(pace, str) else "normal"
    state.notices.clear()
    place = f"({target[0] / 100:.2f}m, {target[1] / 100:.2f}m)"
    if math.dist(state.position, target) <= rules.nearby:
        return f"moved to {place}, already there"
    _free_hands(world)
    state.pace = pace if pace in rules.pace else "normal"
    if state.pace == "accel":
        world.shake_food()
    length = _travel(world, target)
    return f"moved to {place}, route {length / 100:.2f}m"


def _target(action: Action, bare_cm: bool) -> Point:
    x = number(argument(action, 0, "x"), action, "x")
    y = number(argument(action, 1, "y"), action, "y")
    if not bare_cm:
        x, y = x * 100.0, y * 100.0
    if abs(x) > MAX_COORDINATE or abs(y) > MAX_COORDINATE:
        far = MAX_COORDINATE / 100.0
        raise unread(action, f"({x / 100:.0f}m, {y / 100:.0f}m) lies outside the world (at most {far:.0f}m from 0)")
    return (round(x, 4), round(y, 4))


def _free_hands(world: Shift) -> None:
    """Refuse to ride, drive or drag with food in the hand, unless the rules let it pass."""
    state = world.state
    if world.rules.ride_with_food_in_hand or state.mode == "walk":
        return
    full = [order for order in state.orders.values() if order.pending]
    if full:
        numbers = ", ".join(str(order.offer.id) for order in full)
        raise Refused(
            "MV_FOOD_IN_HAND",
            f"you hold the food of order {numbers} in your hands: bag it first, for example "
            f"PLACE_FOOD_IN_BAG(bag_cmd={suggestion(full)!r}), or go on foot",
        )


def _travel(world: Shift, target: Point) -> float:
    """Walk the route to ``target``; returns its length (cm). Raises Refused when the move ends early."""
    state, rules = world.state, world.rules
    if not rules.ghost_car:
        # Rent that ran out while standing still interrupts nothing.
        state.interrupt_at = None
    route = world.route(target)
    body = Follower(state.position, waypoints_of(route), world.step_length(), rules.nearby, rules.stop_radius)
    start = state.tick
    limit = min(world.last_tick, interruption(world)) - start
    empty = _ticks_until_empty(world)
    ticks, arrived = body.run(target, min(limit, empty))
    if not arrived and ticks < min(limit, empty):
        # The last waypoint is reached within rounding: the move is complete.
        arrived = True
    if arrived and not rules.free_last_metres:
        ticks += body.settle(min(limit, empty) - ticks)
    mode = state.mode
    exhausted, depleted = _arrive(world, body, emptied=ticks == empty)
    if depleted:
        # All but the last tick were spent riding.
        world.recorder.mode_ticks[mode] += ticks - 1
        world.recorder.mode_ticks[state.mode] -= ticks - 1
    pass_time(world, start + ticks)
    if exhausted:
        go_to_hospital(world)
        raise Collapsed
    if depleted:
        raise Refused("MV_DEPLETED", "the scooter's battery ran empty on the way: you now drag it", silent=True)
    if not arrived:
        raise blocked()
    if rules.free_last_metres:
        _creep(world, body)
    return sum(math.dist(a, b) for a, b in pairwise(route))


def _creep(world: Shift, body: Follower) -> None:
    """The last metres, which the original does not count as time (they cost energy all the same)."""
    empty = _ticks_until_empty(world)
    before = body.travelled
    ticks = body.settle(empty)
    exhausted, _ = _arrive(world, body, emptied=ticks == empty, since=before)
    if exhausted:
        go_to_hospital(world)


def _ticks_until_empty(world: Shift) -> int:
    """Ticks of movement until energy or battery is gone."""
    state, rules = world.state, world.rules
    metres = world.step_length() / 100.0
    factor = rules.pace[state.pace]
    limit = ticks_until_empty(state.energy, metres * factor * rules.energy_per_m[state.mode])
    found = _UNLIMITED if limit is None else limit
    if state.mode == "e-scooter":
        battery = ticks_until_empty(state.scooter.battery, metres * factor * rules.battery_per_m)
        found = found if battery is None else min(found, battery)
    return found


def _arrive(world: Shift, body: Follower, *, emptied: bool, since: float = 0.0) -> tuple[bool, bool]:
    """Take over the body's position and charge its way; returns (energy gone, battery gone)."""
    state = world.state
    state.position = (round(body.x, 4), round(body.y, 4))
    if body.ux or body.uy:
        state.yaw = heading(body.ux, body.uy)
    return charge_way(world, (body.travelled - since) / 100.0, emptied=emptied)


def charge_way(world: Shift, metres: float, *, emptied: bool = False) -> tuple[bool, bool]:
    """Take energy and battery for ``metres`` in the current mode and pace; returns (energy gone, battery gone).

    With ``emptied`` the level that had to run out does, whatever rounding left of it.
    """
    state, rules = world.state, world.rules
    factor = rules.pace[state.pace]
    slack = 1e-6 if emptied else 0.0
    battery_gone = state.mode == "e-scooter" and world.drain_battery(metres * factor, slack)
    used = metres * factor * rules.energy_per_m[state.mode]
    if state.energy - used <= slack:
        used = state.energy
    state.energy -= used
    world.recorder.energy_used += used
    if battery_gone:
        world.deplete()
    return state.energy <= 0.0, battery_gone


def step_forward(world: Shift, action: Action) -> str:
    """STEP_FORWARD(): one metre along the heading."""
    state, rules = world.state, world.rules
    _free_hands(world)
    if not rules.free_last_metres:
        pass_time(world, state.tick + max(1, math.ceil(rules.step_length / world.step_length() - 1e-9)))
    yaw = math.radians(state.yaw)
    x, y = state.position
    length = rules.step_length
    state.position = (round(x + length * math.cos(yaw), 4), round(y + length * math.sin(yaw), 4))
    exhausted, _ = charge_way(world, length / 100.0)
    if exhausted:
        go_to_hospital(world)
    return "stepped forward 1m"


def turn_around(world: Shift, action: Action) -> str:
    """TURN_AROUND(angle=, direction=): turn by degrees, clockwise for ``right``, else the other way."""
    state = world.state
    angle = argument(action, 0, "angle")
    direction = argument(action, 1, "direction")
    right = isinstance(direction, str) and direction.strip().lower() == "right"
    numeric = isinstance(angle, (int, float)) and abs(angle) <= MAX_INTEGER
    if not numeric and not right:
        raise Refused("TA_BAD", f"angle must be a number of degrees, not {short(angle)}; write {_TURN}")
    turn = float(angle) if isinstance(angle, (int, float)) and numeric else 0.0
    state.yaw = (state.yaw + (turn if right else -turn)) % 360.0
    return f"turned {'right' if right else 'left'} by {turn:.0f} degrees"


_TURN = 'TURN_AROUND(angle=90, direction="right")'
