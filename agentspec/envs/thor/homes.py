"""Scenes of our own: a kitchen, a living room, a bedroom, and an apartment of three rooms with doors.

They are written down as furniture along the walls; the cells an agent can stand on follow from the boxes. Small objects
are placed by tasks (`agentspec.envs.alfred.own`) or stand where the apartment has them.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

from agentspec.envs.thor.kinds import kind
from agentspec.envs.thor.scene import GRID, Cell, Scene, Thing, Vector, thing

RADIUS = 0.2
"""Metres around a cell's point that must be free for the agent to stand there."""

WALL = 2.5
"""Height of walls, metres."""

# type, x, height of the bottom, z (middle, metres), and (width, height, depth)
Row = tuple[str, float, float, float, Vector]

KITCHEN: tuple[Row, ...] = (
    ("Fridge", 0.45, 0.0, 3.6, (0.8, 1.75, 0.7)),
    ("CounterTop", 0.35, 0.0, 1.9, (0.65, 0.92, 2.2)),
    ("CounterTop", 2.0, 0.0, 0.35, (2.2, 0.92, 0.65)),
    ("SinkBasin", 2.4, 0.86, 0.38, (0.5, 0.06, 0.4)),
    ("Sink", 2.4, 0.84, 0.35, (0.6, 0.08, 0.5)),
    ("Faucet", 2.4, 0.93, 0.14, (0.1, 0.25, 0.15)),
    ("Microwave", 0.35, 0.92, 2.6, (0.4, 0.3, 0.5)),
    ("CoffeeMachine", 1.2, 0.92, 0.3, (0.2, 0.35, 0.3)),
    ("Toaster", 0.3, 0.92, 1.1, (0.2, 0.2, 0.3)),
    ("Cabinet", 3.6, 0.0, 0.3, (0.7, 0.8, 0.5)),
    ("Drawer", 0.36, 0.68, 1.6, (0.6, 0.2, 0.5)),
    ("Drawer", 1.6, 0.68, 0.36, (0.5, 0.2, 0.6)),
    ("DiningTable", 3.0, 0.0, 3.0, (0.9, 0.75, 1.3)),
    ("GarbageCan", 4.2, 0.0, 0.4, (0.35, 0.45, 0.35)),
    ("StoveBurner", 0.3, 0.92, 2.05, (0.22, 0.03, 0.22)),
)
LIVING: tuple[Row, ...] = (
    ("Sofa", 2.4, 0.0, 0.5, (2.0, 0.55, 0.85)),
    ("ArmChair", 0.5, 0.0, 1.4, (0.8, 0.5, 0.8)),
    ("CoffeeTable", 2.4, 0.0, 1.9, (1.0, 0.45, 0.5)),
    ("Dresser", 4.2, 0.0, 3.0, (0.5, 0.9, 1.2)),
    ("Drawer", 4.2, 0.62, 2.7, (0.48, 0.2, 0.5)),
    ("Drawer", 4.2, 0.62, 3.3, (0.48, 0.2, 0.5)),
    ("Television", 2.2, 0.52, 3.85, (0.95, 0.6, 0.15)),
    ("TVStand", 2.2, 0.0, 3.75, (1.4, 0.5, 0.4)),
    ("SideTable", 0.35, 0.0, 3.6, (0.5, 0.6, 0.5)),
    ("FloorLamp", 4.2, 0.0, 0.4, (0.35, 1.6, 0.35)),
    ("Safe", 0.35, 0.0, 2.6, (0.45, 0.5, 0.45)),
    ("Shelf", 4.25, 1.1, 1.4, (0.3, 0.03, 0.8)),
)
BEDROOM: tuple[Row, ...] = (
    ("Bed", 1.1, 0.0, 2.9, (1.8, 0.6, 2.0)),
    ("SideTable", 0.4, 0.0, 1.4, (0.5, 0.6, 0.45)),
    ("Desk", 3.2, 0.0, 0.4, (1.4, 0.75, 0.65)),
    ("Drawer", 3.65, 0.52, 0.42, (0.4, 0.18, 0.55)),
    ("DeskLamp", 2.75, 0.75, 0.25, (0.2, 0.45, 0.2)),
    ("Dresser", 4.2, 0.0, 2.8, (0.5, 0.9, 1.2)),
    ("Drawer", 4.2, 0.62, 2.5, (0.48, 0.2, 0.5)),
    ("Drawer", 4.2, 0.62, 3.1, (0.48, 0.2, 0.5)),
    ("LaundryHamper", 0.35, 0.0, 0.4, (0.45, 0.6, 0.45)),
    ("GarbageCan", 2.1, 0.0, 0.3, (0.3, 0.4, 0.3)),
    ("ArmChair", 3.0, 0.0, 3.5, (0.8, 0.5, 0.8)),
)
ROOMS: dict[str, tuple[tuple[float, float], tuple[Row, ...]]] = {
    "Kitchen1": ((4.5, 4.0), KITCHEN),
    "LivingRoom1": ((4.5, 4.0), LIVING),
    "Bedroom1": ((4.5, 4.0), BEDROOM),
}
"""Our household scenes: name -> (width, depth in metres), furniture."""

APARTMENT: tuple[Row, ...] = (
    # the west room: living
    ("Sofa", 1.6, 0.0, 0.5, (1.8, 0.55, 0.85)),
    ("TVStand", 1.6, 0.0, 3.75, (1.4, 0.5, 0.4)),
    ("Television", 1.6, 0.5, 3.8, (0.95, 0.6, 0.15)),
    ("SideTable", 0.35, 0.0, 2.0, (0.5, 0.6, 0.5)),
    ("Vase", 0.35, 0.6, 2.0, (0.14, 0.3, 0.14)),
    ("HousePlant", 3.1, 0.0, 3.7, (0.35, 0.7, 0.35)),
    # the middle room: study
    ("Desk", 5.2, 0.0, 3.6, (1.4, 0.75, 0.65)),
    ("Laptop", 5.2, 0.75, 3.55, (0.34, 0.24, 0.26)),
    ("AlarmClock", 5.7, 0.75, 3.6, (0.12, 0.1, 0.08)),
    ("Chair", 5.0, 0.0, 2.9, (0.5, 0.9, 0.5)),
    ("GarbageCan", 6.7, 0.0, 3.7, (0.35, 0.45, 0.35)),
    ("BasketBall", 6.6, 0.0, 0.4, (0.24, 0.24, 0.24)),
    ("Dresser", 5.0, 0.0, 0.3, (1.2, 0.8, 0.5)),
    ("SprayBottle", 4.7, 0.8, 0.3, (0.1, 0.24, 0.08)),
    # the east room: bedroom and table
    ("Bed", 9.4, 0.0, 2.9, (1.8, 0.6, 2.0)),
    ("BaseballBat", 8.05, 0.0, 3.85, (0.08, 0.75, 0.08)),
    ("DiningTable", 9.6, 0.0, 0.6, (1.3, 0.75, 0.8)),
    ("Apple", 9.3, 0.75, 0.6, (0.09, 0.09, 0.09)),
    ("Mug", 9.8, 0.75, 0.6, (0.12, 0.1, 0.1)),
    ("Bowl", 9.6, 0.75, 0.8, (0.16, 0.07, 0.16)),
)
# walls between the rooms, with a door of 1 m: (x, from z, to z)
DOORS: tuple[tuple[float, float, float], ...] = (
    (3.5, 0.0, 1.6),
    (3.5, 2.6, 4.0),
    (7.5, 0.0, 0.7),
    (7.5, 1.7, 4.0),
)


def _box(row: Row) -> Thing:
    type_name, x, bottom, z, size = row
    return thing(type_name, (x, bottom, z), size=size)


def free_cells(
    west: float,
    south: float,
    east: float,
    north: float,
    things: Iterable[Thing],
    walls: Iterable[tuple[Vector, Vector]],
) -> frozenset[Cell]:
    """The cells of a rectangle at which a disc of `RADIUS` meets no box: the largest connected part of them."""
    boxes = [(t.centre, t.size) for t in things if "pickupable" not in kind(t.type).abilities or t.centre[1] < 0.6]
    boxes += list(walls)
    low = [(c[1] - s[1] / 2) for c, s in boxes]
    found = set()
    for i in range(round(west / GRID), round(east / GRID) + 1):
        for j in range(round(south / GRID), round(north / GRID) + 1):
            x, z = i * GRID, j * GRID
            inside = west + RADIUS <= x <= east - RADIUS and south + RADIUS <= z <= north - RADIUS
            if inside and not any(
                b < 1.8 and abs(x - c[0]) < s[0] / 2 + RADIUS and abs(z - c[2]) < s[2] / 2 + RADIUS
                for b, (c, s) in zip(low, boxes, strict=True)
            ):
                found.add((i, j))
    return frozenset(_largest(found))


def _largest(cells: set[Cell]) -> set[Cell]:
    best: set[Cell] = set()
    left = set(cells)
    while left:
        part, queue = set(), [left.pop()]
        while queue:
            x, z = queue.pop()
            part.add((x, z))
            for near in ((x + 1, z), (x - 1, z), (x, z + 1), (x, z - 1)):
                if near in left:
                    left.remove(near)
                    queue.append(near)
        best = max(best, part, key=len)
    return best


def outer_walls(width: float, depth: float) -> list[tuple[Vector, Vector]]:
    """Four walls around a floor that starts at the origin."""
    h = WALL
    return [
        ((width / 2, h / 2, -0.05), (width + 0.2, h, 0.1)),
        ((width / 2, h / 2, depth + 0.05), (width + 0.2, h, 0.1)),
        ((-0.05, h / 2, depth / 2), (0.1, h, depth + 0.2)),
        ((width + 0.05, h / 2, depth / 2), (0.1, h, depth + 0.2)),
    ]


@lru_cache(maxsize=16)
def room(name: str) -> Scene:
    """One of `ROOMS`.

    Raises:
        LookupError: there is none of this name.
    """
    if name not in ROOMS:
        raise LookupError(f"there is no room {name!r}; expected one of {', '.join(ROOMS)}")
    (width, depth), rows = ROOMS[name]
    things = tuple(_box(row) for row in rows)
    walls = outer_walls(width, depth)
    return Scene(name, free_cells(0, 0, width, depth, things, walls), things, tuple(walls))


@lru_cache(maxsize=1)
def apartment() -> Scene:
    """Three rooms in a row, 11 m x 4 m, with doors between them and eight kinds of things to look for."""
    things = tuple(_box(row) for row in APARTMENT)
    walls = outer_walls(11.0, 4.0)
    walls += [((x, WALL / 2, (a + b) / 2), (0.1, WALL, b - a)) for x, a, b in DOORS]
    return Scene("Apartment1", free_cells(0, 0, 11.0, 4.0, things, walls), things, tuple(walls))
