"""A scene: the cells an agent can stand on, boxes with abilities, walls, and what is known of sight lines.

Lengths are metres, x to the east, y up, z to the north; a cell is a point of the grid in multiples of `GRID`. Scenes
are plain data: they come from code of ours (`homes`) or from recorded metadata and layouts (`mining`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from agentspec.envs.thor.kinds import kind

GRID = 0.25
"""Metres between neighbouring cells, in AI2-THOR and here."""

Cell = tuple[int, int]
Vector = tuple[float, float, float]


def cell_at(x: float, z: float) -> Cell:
    """The cell nearest to a point."""
    return round(x / GRID), round(z / GRID)


def object_id(type_name: str, position: Iterable[float]) -> str:
    """AI2-THOR's id of an object that starts at `position`: `Apple|-00.59|+00.83|-00.40`.

    The simulator rounds single-precision numbers: -1.835 becomes `-01.84`.
    """
    return "|".join([type_name, *(f"{np.float32(value):+06.2f}" for value in position)])


@dataclass(frozen=True)
class Thing:
    """An object as a scene starts with it: id, type, axis-aligned box (centre and size, metres), abilities, state.

    Args:
        position: the object's reference point, from which its id is made; usually below the centre of the box.
    """

    id: str
    type: str
    centre: Vector
    size: Vector
    position: Vector
    name: str = ""
    yaw: float = 0.0
    abilities: frozenset[str] = frozenset()
    open: bool = False
    on: bool = False


@dataclass(frozen=True)
class Scene:
    """Everything a world starts with.

    Args:
        name: the scene's name, `FloorPlan10` say.
        cells: where the agent can stand.
        things: the objects.
        walls: boxes as (centre, size) that block sight and are drawn.
        sights: object type -> cells from which objects of it are known to be seen; sight of these types needs to be
            near one of them on foot (recorded scenes do not tell where their walls are).
        aliases: other ids -> ids, for records that name the objects of an older build.
    """

    name: str
    cells: frozenset[Cell]
    things: tuple[Thing, ...]
    walls: tuple[tuple[Vector, Vector], ...] = ()
    sights: Mapping[str, frozenset[Cell]] = field(default_factory=dict)
    aliases: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.cells:
            raise ValueError(f"the scene {self.name!r} has no cell to stand on")

    def ways(self, name: str) -> tuple[dict[Cell, float], dict[Cell, Cell]]:
        """`geodesic.distances` to the known sight cells of a type; searched once for a scene."""
        from agentspec.envs.thor.geodesic import distances

        if name not in self._ways:
            self._ways[name] = distances(self.sights[name], self.cells)
        return self._ways[name]

    def __deepcopy__(self, memo: Any) -> Scene:
        """Nothing of it changes, so a copy is the same."""
        return self

    def __getstate__(self) -> dict[str, Any]:
        """What it is made of, without what is remembered."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @cached_property
    def seen(self) -> dict[Any, dict[Any, Any]]:
        """What players remember of it: how they look -> pose -> what is visible while nothing has been touched."""
        return {}

    @cached_property
    def _ways(self) -> dict[str, tuple[dict[Cell, float], dict[Cell, Cell]]]:
        return {}

    @property
    def area(self) -> tuple[float, float, float, float]:
        """West, south, east and north edge of the floor: half a metre around the cells."""
        xs, zs = [c[0] * GRID for c in self.cells], [c[1] * GRID for c in self.cells]
        return min(xs) - 0.5, min(zs) - 0.5, max(xs) + 0.5, max(zs) + 0.5


def thing(type_name: str, position: Vector, *, size: Vector | None = None, name: str = "", **state: object) -> Thing:
    """An object of `type_name` standing on `position` (the middle of its bottom), as its type is."""
    size = size or kind(type_name).size
    centre = (position[0], position[1] + size[1] / 2, position[2])
    made = object_id(type_name, position)
    return Thing(made, type_name, centre, size, position, name or made, abilities=kind(type_name).abilities, **state)  # type: ignore[arg-type]
