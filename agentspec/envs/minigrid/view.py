"""What an agent sees of a grid, in words: everything from the 7 x 7 cells in front of it, nothing else.

`look` reads the cells that MiniGrid's own partial observation shows (walls occlude) into a `View`, of which `texts`
makes words.

Distances are steps: "2 forward, 1 left". Unseen cells are never described.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from minigrid.core.world_object import Wall

HEADINGS = ("east", "south", "west", "north")
AHEAD = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""One step ahead by heading: x to the east, y to the south."""
OUTSIDE = Wall()
"""Beyond the grid there is wall."""
PICKABLE = frozenset({"key", "ball", "box"})
MARKS = {
    **{"unseen": "?", "agent": "?", "empty": ".", "floor": ".", "wall": "#", "lava": "L"},
    **{"door": "D", "key": "K", "ball": "O", "box": "B", "goal": "G"},
}
"""Characters of the relational map; the agent is `^`, an open door `_`."""
PLAIN = frozenset({"unseen", "empty", "wall", "floor", "agent"})


@dataclass(frozen=True, slots=True)
class Thing:
    """An object in view: `forward` and `right` are steps (`right` negative: to the left)."""

    type: str
    colour: str
    state: str
    forward: int
    right: int

    @property
    def name(self) -> str:
        """Such as "locked red door" or "lava"; goal and lava have no colour of interest."""
        words = [self.state] if self.type == "door" else []
        if self.type not in ("goal", "lava", "wall", "floor"):
            words.append(self.colour)
        return " ".join([*words, self.type])

    @property
    def distance(self) -> int:
        """Steps along the grid, turns not counted."""
        return self.forward + abs(self.right)

    @property
    def place(self) -> str:
        """Such as "2 forward, 1 left"."""
        side = f"{abs(self.right)} {'right' if self.right > 0 else 'left'}" if self.right else ""
        ahead = f"{self.forward} forward" if self.forward else ""
        return ", ".join(p for p in (ahead, side) if p) or "here"


@dataclass(frozen=True)
class View:
    """One look at the grid.

    Args:
        mission: what is asked for.
        heading: compass direction the agent faces.
        carrying: name of what is carried, or "".
        ahead: the thing in the cell in front, walls included; `None` for an empty cell.
        things: objects in view (no walls, no floor), nearest first.
        walls: steps to the nearest visible wall ahead, left and right; 0 where none is in view.
        cells: types of the cells by rows, the agent's own row first, each from left to right.
    """

    mission: str
    heading: str
    carrying: str
    ahead: Thing | None
    things: tuple[Thing, ...]
    walls: tuple[int, int, int]
    cells: tuple[tuple[str, ...], ...]

    @property
    def rows(self) -> tuple[str, ...]:
        """The character map, far row first."""
        size = len(self.cells[0])
        drawn = [[MARKS[kind] for kind in row] for row in self.cells]
        drawn += [["?"] * size for _ in range(size - len(drawn))]
        for thing in self.things:
            if thing.type == "door" and thing.state == "open":
                drawn[thing.forward][thing.right + size // 2] = "_"
        drawn[0][size // 2] = "^"
        return tuple("".join(row) for row in reversed(drawn))

    @property
    def affordances(self) -> tuple[str, ...]:
        """What the cell in front allows: "walk", "pick up", "drop", "toggle", or "deadly"."""
        ahead = self.ahead
        if ahead is None:
            return ("walk", "drop") if self.carrying else ("walk",)
        allowed = []
        if ahead.type in ("goal", "floor") or (ahead.type == "door" and ahead.state == "open"):
            allowed.append("walk")
        if ahead.type in PICKABLE and not self.carrying:
            allowed.append("pick up")
        if ahead.type in ("door", "box"):
            allowed.append("toggle")
        if ahead.type == "lava":
            allowed.append("deadly")
        return tuple(allowed)


def look(world: Any) -> View:
    """What the agent of a running MiniGrid environment (`env.unwrapped`) sees."""
    rows, things = _read(world)
    middle = world.agent_view_size // 2
    ahead = Thing("wall", "", "", 1, 0) if len(rows) > 1 and rows[1][middle] == "wall" else None
    for thing in things:
        if thing.forward == 1 and thing.right == 0:
            ahead = thing
    carried = world.carrying
    return View(
        mission=world.mission,
        heading=HEADINGS[int(world.agent_dir)],
        carrying=f"{carried.color} {carried.type}" if carried else "",
        ahead=ahead,
        things=tuple(things),
        walls=(
            _wall([row[middle] for row in rows[1:]]),
            _wall(rows[0][middle - 1 :: -1]),
            _wall(rows[0][middle + 1 :]),
        ),
        cells=tuple(map(tuple, rows)),
    )


def _read(world: Any) -> tuple[list[list[str]], list[Thing]]:
    """Types of the cells in view by rows, and the things among them, nearest first.

    The same cells as in MiniGrid's own partial observation (`gen_obs`), read from the grid row by row: sight goes
    forward, and to the sides and diagonals from every cell that lets it through.
    """
    size = world.agent_view_size
    middle = size // 2
    grid, width, height = world.grid.grid, world.grid.width, world.grid.height
    ahead_x, ahead_y = AHEAD[world.agent_dir]
    x0, y0 = int(world.agent_pos[0]), int(world.agent_pos[1])
    everything = world.see_through_walls
    things: list[Thing] = []
    rows: list[list[str]] = []
    lit = (1 << size) - 1 if everything else 1 << middle
    for forward in range(size):
        x, y = x0 + forward * ahead_x + middle * ahead_y, y0 + forward * ahead_y - middle * ahead_x
        cells = []
        clear = 0
        for bit in range(size):
            cell = grid[y * width + x] if 0 <= x < width and 0 <= y < height else OUTSIDE
            cells.append(cell)
            if cell is None or cell.see_behind():
                clear |= 1 << bit
            x -= ahead_y
            y += ahead_x
        seen, lit = (lit, lit) if everything else _spread(lit, clear, size)
        row = []
        for bit, cell in enumerate(cells):
            if not seen >> bit & 1:
                row.append("unseen")
            elif cell is None:
                row.append("empty")
            else:
                row.append(cell.type)
                if cell.type not in PLAIN and (forward or bit != middle):
                    things.append(Thing(cell.type, cell.color, _state(cell), forward, bit - middle))
        rows.append(row)
        if not lit:
            break
    return rows, sorted(things, key=_nearness)


@functools.lru_cache(maxsize=1 << 14)
def _spread(lit: int, clear: int, size: int) -> tuple[int, int]:
    """From the cells of a row that light reaches and those it passes: all cells seen in it, and those of the next row.

    Bit i is the i-th cell from the left. Light passes from a clear cell to its neighbours and to the three before it.
    """
    whole, before = (1 << size) - 1, 0
    while lit != before:
        before = lit
        through = lit & clear
        lit |= (through << 1 | through >> 1) & whole
    through = lit & clear
    return lit, (through | through << 1 | through >> 1) & whole


def _state(cell: Any) -> str:
    """The state of a door; other things have none to tell."""
    if cell.type != "door":
        return ""
    return "open" if cell.is_open else "locked" if cell.is_locked else "closed"


def _nearness(thing: Thing) -> tuple[int, int, int]:
    side = abs(thing.right)
    return thing.forward + side, side, thing.right


def _wall(ray: Sequence[str]) -> int:
    """Steps to the first thing on a ray if that is a wall, else 0."""
    for steps, kind in enumerate(ray, 1):
        if kind not in ("empty", "floor"):
            return steps if kind == "wall" else 0
    return 0
