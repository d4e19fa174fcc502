"""ALFRED's goal conditions, and what cleans, heats and cools.

The conditions are those of ALFRED's evaluation: each task type has a fixed number, and a task succeeds when all are met
at once. They read metadata only, so they hold for every player. As there, an object counts as of a type when its id
contains the type's name (`Apple|..|AppleSliced_1` is an `AppleSliced`, and an `Apple` too).

- clean: a tap is turned on; everything in the sink basin nearest to it becomes clean;
- heat: a microwave is turned on; everything in it becomes hot;
- cool: a fridge is closed; everything in it becomes cold.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from agentspec.envs.alfred.trials import Targets
from agentspec.envs.thor.kinds import piece

Object = Mapping[str, Any]


@dataclass
class Changes:
    """Which objects became clean, hot or cold so far: call `follow` after every action."""

    clean: set[str] = field(default_factory=set)
    hot: set[str] = field(default_factory=set)
    cold: set[str] = field(default_factory=set)

    def follow(self, metadata: Mapping[str, Any], object_id: str) -> None:
        """Take note of what the last action, on `object_id`, did.

        Args:
            metadata: after the action.
            object_id: of the tap, microwave or fridge.
        """
        if not metadata["lastActionSuccess"]:
            return
        action, objects = metadata["lastAction"], metadata["objects"]
        if action == "ToggleObjectOn" and "Faucet" in object_id:
            self.clean |= set(_basin(objects, object_id))
        elif action == "ToggleObjectOn" and "Microwave" in object_id:
            self.hot |= {i for o in _called(objects, "Microwave") for i in o["receptacleObjectIds"] or ()}
        elif action == "CloseObject" and "Fridge" in object_id:
            self.cold |= {i for o in _called(objects, "Fridge") for i in o["receptacleObjectIds"] or ()}

    def data(self) -> dict[str, list[str]]:
        """JSON data, for snapshots."""
        return {"clean": sorted(self.clean), "hot": sorted(self.hot), "cold": sorted(self.cold)}


def _basin(objects: Iterable[Object], faucet_id: str) -> Iterable[str]:
    objects = list(objects)
    faucet = next((o for o in objects if o["objectId"] == faucet_id), None)
    basins = [o for o in objects if "SinkBasin" in o["objectId"]]
    if faucet is None or not basins:
        return ()
    here = tuple(faucet["position"].values())
    return min(basins, key=lambda o: math.dist(tuple(o["position"].values()), here))["receptacleObjectIds"] or ()


@dataclass(frozen=True)
class Progress:
    """Goal conditions met, of how many."""

    met: int
    total: int

    @property
    def share(self) -> float:
        """Met over total."""
        return self.met / self.total

    @property
    def success(self) -> bool:
        """Whether all are met."""
        return self.met == self.total


def progress(task_type: str, targets: Targets, metadata: Mapping[str, Any], changes: Changes) -> Progress:
    """The goal conditions of a task as they stand."""
    objects = metadata["objects"]
    name = piece(targets.object) if targets.sliced else targets.object
    wanted = [o for o in _called(objects, name) if o["pickupable"] or o["isPickedUp"]]
    parent = {"Sink": "SinkBasin", "Bathtub": "BathtubBasin"}.get(targets.parent, targets.parent)
    receptacles = [o for o in _called(objects, parent) if o["receptacle"]] if parent else []
    pieces = [o for o in wanted if piece(targets.object) in o["objectId"]]
    met, total = CONDITIONS[task_type](wanted, receptacles, targets, metadata, changes)
    if targets.sliced:
        extra = 2 if task_type == "pick_two_obj_and_place" else 1
        met, total = met + min(len(pieces), extra), total + extra
    return Progress(met, total)


def _called(objects: Iterable[Object], name: str) -> list[Object]:
    return [o for o in objects if name in o["objectId"]]


def _inside(one: Object, container: Object) -> bool:
    return one["objectId"] in (container["receptacleObjectIds"] or ())


def _placed(wanted: list[Object], receptacles: list[Object]) -> set[str]:
    return {p["objectId"] for p in wanted if any(_inside(p, r) for r in receptacles)}


def _simple(wanted: Any, receptacles: Any, *_: Any) -> tuple[int, int]:
    return int(bool(_placed(wanted, receptacles))), 1


def _two(wanted: Any, receptacles: Any, *_: Any) -> tuple[int, int]:
    return min(max((sum(_inside(p, r) for p in wanted) for r in receptacles), default=0), 2), 2


def _light(wanted: Any, _receptacles: Any, targets: Targets, metadata: Any, _changes: Any) -> tuple[int, int]:
    held = {o["objectId"] for o in metadata["inventoryObjects"]}
    lamps = [o for o in _called(metadata["objects"], targets.toggle) if o["toggleable"]]
    lit = any(o["isToggled"] and o["visible"] for o in lamps)
    return int(any(p["objectId"] in held for p in wanted)) + int(lit), 2


def _treated(kind: str) -> Callable[..., tuple[int, int]]:
    def conditions(wanted: Any, receptacles: Any, _targets: Any, _metadata: Any, changes: Changes) -> tuple[int, int]:
        placed, done = _placed(wanted, receptacles), getattr(changes, kind) & {p["objectId"] for p in wanted}
        return int(bool(placed)) + int(bool(done)) + int(bool(placed & done)), 3

    return conditions


def _movable(wanted: Any, receptacles: Any, targets: Targets, metadata: Any, _changes: Any) -> tuple[int, int]:
    movables = [o for o in _called(metadata["objects"], targets.movable) if o["pickupable"] and o["receptacle"]]
    placed = _placed(movables, receptacles)
    filled = {m["objectId"] for m in movables if any(_inside(p, m) for p in wanted)}
    return int(bool(placed)) + int(bool(filled)) + int(bool(placed & filled)), 3


CONDITIONS: dict[str, Callable[..., tuple[int, int]]] = {
    "pick_and_place_simple": _simple,
    "pick_two_obj_and_place": _two,
    "pick_heat_then_place_in_recep": _treated("hot"),
    "pick_cool_then_place_in_recep": _treated("cold"),
    "pick_clean_then_place_in_recep": _treated("clean"),
    "look_at_obj_in_light": _light,
    "pick_and_place_with_movable_recep": _movable,
}
"""Task type -> its conditions, slicing aside: wanted, receptacles, targets, metadata, changes -> met, total."""
