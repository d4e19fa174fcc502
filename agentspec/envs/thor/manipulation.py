"""What can be done to objects: pick up, put, open, close, switch, slice; it fails with a message, or is done.

Every action needs its object in view (`forceAction` or `forceVisible` wave no such rule here: recorded plans that set
them do what they do in view).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from agentspec.envs.thor.kinds import KNIVES, SLICES, kind, piece
from agentspec.envs.thor.protocol import Refused
from agentspec.envs.thor.state import Body

if TYPE_CHECKING:
    from agentspec.envs.thor.engine import OfflineThor

Action = Mapping[str, Any]


def find(world: OfflineThor, object_id: str) -> Body:
    """The object of an id, or of an id that an older build gave it.

    Raises:
        Refused: there is none.
    """
    bodies = world.state.bodies
    one = bodies.get(object_id) or bodies.get(world.scene.aliases.get(object_id, ""))
    if one is None:
        raise Refused(f"there is no object {object_id!r}")
    return one


def _target(world: OfflineThor, action: Action, field: str, ability: str) -> Body:
    one = find(world, str(action[field]))
    if ability not in one.abilities:
        raise Refused(f"{one.id} is not {ability}")
    if not world.sees(one):
        raise Refused(f"{one.id} is not visible from here; it must be in view and within reach")
    return one


def pick_up(world: OfflineThor, action: Action) -> None:
    """Take an object, with all that is in it."""
    one = _target(world, action, "objectId", "pickupable")
    held = world.state.held()
    if held is not None:
        raise Refused(f"the hand is not empty, it holds {held.id}")
    one.held, one.parents = True, []
    if "receptacle" in one.abilities:
        for inner in world.state.contents(one.id):
            inner.parents = [p for p in inner.parents if p == one.id or one.id in world.state.bodies[p].parents]
    world.touched()


def put(world: OfflineThor, action: Action) -> None:
    """Put what is held into or onto a receptacle that is in view, and open if it can be closed."""
    held = world.state.held()
    if held is None:
        raise Refused("the hand is empty, there is nothing to put")
    target = _target(world, action, "receptacleObjectId", "receptacle")
    if target.id == held.id or held.id in target.parents:
        raise Refused("an object cannot be put into itself, nor into what is in it")
    if target.closed:
        raise Refused(f"{target.id} is closed; open it first")
    spot = free_spot(world, held, target, bool(action.get("forceAction")))
    if spot is None:
        raise Refused(f"no room for {held.id} in {target.id}")
    moved = held.move(spot)
    for inner in world.state.contents(held.id):
        inner.shift(*moved)
        inner.parents = [*inner.parents, target.id, *target.parents]
    held.held, held.parents = False, [target.id, *target.parents]
    world.touched()


def free_spot(world: OfflineThor, one: Body, target: Body, crowd: bool) -> list[float] | None:
    """Where the middle of `one` comes to stand in or on `target`: the free place nearest to the agent.

    With `crowd` the places taken are used too, once all are: AI2-THOR's forced placement.
    """
    (w, h, d), (tw, th, td) = one.size, target.size
    if min(w, d) > (2.5 if crowd else 1.1) * max(tw, td):
        return None
    low = target.low
    inner = "openable" in target.abilities or target.type in ("Box", "SinkBasin", "BathtubBasin", "GarbageCan", "Cup")
    levels = [low[1] + 0.03 + th * f for f in ((0.0, 0.35, 0.65) if inner and th > 0.8 else (0.0,))]
    levels = levels if inner else [low[1] + th]
    others = [b for b in world.state.contents(target.id) if b.id != one.id]
    agent = world.state.agent
    best: tuple[bool, float, list[float]] | None = None
    for y in levels:
        for x in _spread(low[0], tw, w):
            for z in _spread(low[2], td, d):
                taken = any(_overlap(b, x, y, z, w, d) for b in others)
                rank = (taken, math.hypot(x - agent.x, z - agent.z), [x, y + h / 2, z])
                if best is None or rank < best:
                    best = rank
    return None if best is None or (best[0] and not crowd) else best[2]


def _spread(low: float, room: float, need: float) -> list[float]:
    """Places along one side, about 10 cm apart, at which something `need` wide stands within `room`."""
    spare = room - need - 0.04
    if spare <= 0:
        return [low + room / 2]
    n = max(1, round(spare / 0.1))
    return [low + 0.02 + need / 2 + spare * i / n for i in range(n + 1)]


def _overlap(b: Body, x: float, y: float, z: float, w: float, d: float) -> bool:
    near = abs(b.centre[0] - x) < (b.size[0] + w) / 2 and abs(b.centre[2] - z) < (b.size[2] + d) / 2
    return near and abs(b.low[1] - y) < 0.3


def _opening(world: OfflineThor, action: Action, opened: bool) -> None:
    one = _target(world, action, "objectId", "openable")
    if one.open is opened:
        raise Refused(f"{one.id} is {'open' if opened else 'closed'} already")
    if opened and one.on and one.type == "Microwave":
        raise Refused(f"{one.id} is on; switch it off first")
    one.open = opened
    world.touched()


def _switching(world: OfflineThor, action: Action, on: bool) -> None:
    one = _target(world, action, "objectId", "toggleable")
    if one.on is on:
        raise Refused(f"{one.id} is {'on' if on else 'off'} already")
    if on and one.type == "Microwave" and one.open:
        raise Refused(f"{one.id} is open; close it first")
    one.on = on
    if on and one.type == "Faucet":
        _rinse(world, one)
    world.touched()


def _rinse(world: OfflineThor, faucet: Body) -> None:
    """Water cleans what lies in the nearest basin."""
    basins = [b for b in world.state.bodies.values() if b.type in ("SinkBasin", "BathtubBasin")]
    if basins:
        nearest = min(basins, key=lambda b: math.dist(b.centre, faucet.centre))
        for one in world.state.contents(nearest.id):
            one.dirty = False


def cut(world: OfflineThor, action: Action) -> None:
    """Slice an object with a knife in the hand: its pieces lie where it was."""
    one = _target(world, action, "objectId", "sliceable")
    held = world.state.held()
    if world.settings.knife and (held is None or held.type not in KNIVES) and one.type != "Egg":
        raise Refused("slicing needs a knife in the hand")
    if one.held:
        raise Refused(f"{one.id} is in the hand; put it down first")
    del world.state.bodies[one.id]
    count = SLICES.get(one.type, 4)
    width, height, depth = one.size
    for number in range(1, count + 1):
        x = one.centre[0] + width * ((number - 0.5) / count - 0.5)
        made = f"{one.id}|{piece(one.type)}_{number}"
        centre = [x, one.centre[1], one.centre[2]]
        bottom = [x, one.low[1], one.centre[2]]
        world.state.bodies[made] = Body(
            made, piece(one.type), made, centre, [width / count, height, depth], bottom, one.yaw,
            sorted(kind(one.type).abilities - {"sliceable"}), list(one.parents), sliced=True, dirty=one.dirty,
        )  # fmt: skip
    world.touched()


ACTIONS: dict[str, Callable[[OfflineThor, Action], None]] = {
    "PickupObject": pick_up,
    "PutObject": put,
    "OpenObject": lambda world, action: _opening(world, action, True),
    "CloseObject": lambda world, action: _opening(world, action, False),
    "ToggleObjectOn": lambda world, action: _switching(world, action, True),
    "ToggleObjectOff": lambda world, action: _switching(world, action, False),
    "SliceObject": cut,
}
"""Action -> what carries it out: it changes the world or raises `Refused`."""
