"""The changing part of an offline world: where the agent stands, and every object's box and condition."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from agentspec.envs.thor.scene import Scene, Thing, Vector

SNAPSHOT_VERSION = 1


@dataclass(slots=True)
class Body:
    """An object as it is now. Boxes are in metres; `held` objects are in the agent's hand, in nothing else."""

    id: str
    type: str
    name: str
    centre: list[float]
    size: list[float]
    position: list[float]
    yaw: float
    abilities: list[str]
    parents: list[str] = field(default_factory=list)
    open: bool = False
    on: bool = False
    held: bool = False
    sliced: bool = False
    dirty: bool = False
    filled: bool = False

    @property
    def low(self) -> tuple[float, float, float]:
        """The corner of the box with the smallest coordinates."""
        (x, y, z), (w, h, d) = self.centre, self.size
        return x - w / 2, y - h / 2, z - d / 2

    @property
    def high(self) -> tuple[float, float, float]:
        """The corner of the box with the largest coordinates."""
        (x, y, z), (w, h, d) = self.centre, self.size
        return x + w / 2, y + h / 2, z + d / 2

    @property
    def closed(self) -> bool:
        """Whether it is a container that hides what it holds (a cardboard box never does)."""
        shuts = "openable" in self.abilities and "receptacle" in self.abilities and "pickupable" not in self.abilities
        return shuts and not self.open

    def move(self, to: Iterable[float]) -> tuple[float, float, float]:
        """Put the centre of the box at `to`; returns by how much it moved."""
        new = list(to)
        dx, dy, dz = (n - c for n, c in zip(new, self.centre, strict=True))
        self.shift(dx, dy, dz)
        return dx, dy, dz

    def shift(self, dx: float, dy: float, dz: float) -> None:
        """Move the box and its reference point."""
        for i, delta in enumerate((dx, dy, dz)):
            self.centre[i] += delta
            self.position[i] += delta


def body(thing: Thing) -> Body:
    """An object as its scene starts with it."""
    return Body(
        thing.id,
        thing.type,
        thing.name,
        list(thing.centre),
        list(thing.size),
        list(thing.position),
        thing.yaw,
        sorted(thing.abilities),
        [],
        open=thing.open,
        on=thing.on,
    )


@dataclass(slots=True)
class Agent:
    """Where the agent stands (x, z in metres) and looks (degrees: yaw clockwise from north, horizon downwards)."""

    x: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    horizon: float = 0.0
    standing: bool = True


@dataclass(slots=True)
class State:
    """Agent and objects; `dump` and `load` are exact."""

    scene: str
    agent: Agent
    bodies: dict[str, Body]

    def held(self) -> Body | None:
        """What the agent holds."""
        return next((b for b in self.bodies.values() if b.held), None)

    def contents(self, container: str) -> list[Body]:
        """What is directly or further in or on an object."""
        return [b for b in self.bodies.values() if container in b.parents]

    def dump(self) -> dict[str, Any]:
        """JSON data."""
        return {
            "version": SNAPSHOT_VERSION,
            "scene": self.scene,
            "agent": asdict(self.agent),
            "bodies": [[getattr(b, f.name) for f in fields(Body)] for b in self.bodies.values()],
        }


def load(data: dict[str, Any]) -> State:
    """The state of a `dump`.

    Raises:
        ValueError: of another version, or no dump at all.
    """
    try:
        if data["version"] != SNAPSHOT_VERSION:
            raise ValueError(f"got a state of version {data['version']}; this release reads {SNAPSHOT_VERSION}")
        copies = json.loads(json.dumps(data["bodies"]))
        bodies = [Body(*values) for values in copies]
        return State(data["scene"], Agent(**data["agent"]), {b.id: b for b in bodies})
    except (KeyError, TypeError) as error:
        raise ValueError(f"this is no state of a household world ({error!r})") from error


def settle(bodies: dict[str, Body]) -> None:
    """Find out what stands in or on what, by boxes."""
    containers = [b for b in bodies.values() if "receptacle" in b.abilities and b.type != "Floor"]
    for one in bodies.values():
        if "pickupable" not in one.abilities:
            continue
        around = [c for c in containers if c.id != one.id and contains(c, one)]
        if any(_lidded(c) for c in around):  # what is in a drawer is not on the desk that the drawer is in
            around = [c for c in around if _lidded(c) or "pickupable" in c.abilities]
        one.parents = [c.id for c in around]


def contains(container: Body, one: Body) -> bool:
    """Whether a box is in or on a receptacle: its middle is over the receptacle, its bottom within it or on its top."""
    low, high = container.low, container.high
    x, z, bottom = one.centre[0], one.centre[2], one.low[1]
    if one.size[0] * one.size[2] > 1.5 * container.size[0] * container.size[2]:
        return False
    reach = -0.01 if _lidded(container) else 0.12  # what lies on a drawer is not in it
    inside = low[0] - 0.03 <= x <= high[0] + 0.03 and low[2] - 0.03 <= z <= high[2] + 0.03
    return inside and low[1] - 0.08 <= bottom <= high[1] + reach


def _lidded(container: Body) -> bool:
    return "openable" in container.abilities and "pickupable" not in container.abilities


def place(scene: Scene) -> State:
    """The state a scene starts with; the agent stands on its first cell."""
    first = min(scene.cells)
    bodies = {t.id: body(t) for t in scene.things}
    settle(bodies)
    return State(scene.name, Agent(first[0] * 0.25, first[1] * 0.25), bodies)


__all__ = ["Agent", "Body", "State", "Vector", "contains", "load", "place", "settle"]
