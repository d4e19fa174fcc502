"""What an agent sees of a grid, in words: everything from the 7 x 7 cells in front of it, nothing else.

`look` reads MiniGrid's own partial observation (`gen_obs`, walls occlude) into a `View`; three texts are made of it:

- `compact`: one short line per aspect, at most 80 tokens of a small model's vocabulary on the suites offered;
- `basic`: sentences, one per thing seen;
- `relational`: what the cell ahead affords, objects by distance, walls to the sides, and a character map.

Distances are steps: "2 forward, 1 left". Unseen cells are never described.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX, STATE_TO_IDX

HEADINGS = ("east", "south", "west", "north")
TYPES = {index: name for name, index in OBJECT_TO_IDX.items()}
COLOURS = {index: name for name, index in COLOR_TO_IDX.items()}
STATES = {index: name for name, index in STATE_TO_IDX.items()}
PICKABLE = frozenset({"key", "ball", "box"})
MARKS = {
    **{"unseen": "?", "agent": "?", "empty": ".", "floor": ".", "wall": "#", "lava": "L"},
    **{"door": "D", "key": "K", "ball": "O", "box": "B", "goal": "G"},
}
"""Characters of the relational map; the agent is `^`, an open door `_`."""
LEGEND = "you are ^ and look up; # wall, . free, ? unseen, D door, _ open door, K key, O ball, B box, G goal, L lava"
PLAIN = frozenset({"unseen", "empty", "wall", "floor", "agent"})
UNSEEN = OBJECT_TO_IDX["unseen"]
MOST_SHOWN = 3
"""Things, or rows of equal things, that the compact text names."""


@dataclass(frozen=True)
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
        rows: the character map, far row first.
    """

    mission: str
    heading: str
    carrying: str
    ahead: Thing | None
    things: tuple[Thing, ...]
    walls: tuple[int, int, int]
    rows: tuple[str, ...]

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


def look(grid: Any, image: Any = None) -> View:
    """What the agent of a running MiniGrid environment (`env.unwrapped`) sees.

    Args:
        image: the symbolic view that the last step returned, uint8 (7, 7, 3); default: looks now.
    """
    seen = (grid.gen_obs()["image"] if image is None else image).tolist()
    size = len(seen)
    middle, bottom = size // 2, size - 1
    things: list[Thing] = []
    kinds: dict[tuple[int, int], str] = {}
    rows = [["?"] * size for _ in range(size)]
    for column, cells in enumerate(seen):
        for row, (kind, colour, state) in enumerate(cells):
            if kind == UNSEEN or (column == middle and row == bottom):
                continue  # the agent's own cell shows what it carries
            name = TYPES[kind]
            kinds[bottom - row, column - middle] = name
            rows[row][column] = MARKS[name]
            if name not in PLAIN:
                thing = Thing(name, COLOURS[colour], STATES[state], bottom - row, column - middle)
                things.append(thing)
                if name == "door" and thing.state == "open":
                    rows[row][column] = "_"
    rows[bottom][middle] = "^"
    things.sort(key=lambda t: (t.distance, abs(t.right), t.right))
    ahead = next((t for t in things if t.forward == 1 and t.right == 0), None)
    if kinds.get((1, 0)) == "wall":
        ahead = Thing("wall", "", "", 1, 0)
    return View(
        mission=grid.mission,
        heading=HEADINGS[int(grid.agent_dir)],
        carrying=f"{grid.carrying.color} {grid.carrying.type}" if grid.carrying else "",
        ahead=ahead,
        things=tuple(things),
        walls=(_wall(kinds, 1, 0, size), _wall(kinds, 0, -1, size), _wall(kinds, 0, 1, size)),
        rows=tuple("".join(row) for row in rows),
    )


def _wall(kinds: Mapping[tuple[int, int], str], forward: int, right: int, size: int) -> int:
    """Steps to the first thing on a ray if that is a wall, else 0."""
    for steps in range(1, size):
        kind = kinds.get((forward * steps, right * steps), "unseen")
        if kind not in ("empty", "floor"):
            return steps if kind == "wall" else 0
    return 0


def compact(view: View, last: str = "") -> str:
    """The shortest text that a good player needs; cells of one kind in a row or a column are named together."""
    front = view.ahead.name if view.ahead else "nothing"
    carrying = f", carrying {view.carrying}" if view.carrying else ""
    lines = [f"Mission: {view.mission}."]
    if last:
        lines.append(f"Last: {last}.")
    lines.append(f"Facing {view.heading}{carrying}. In front: {front}.")
    others = [t for t in view.things if (t.forward, t.right) != (1, 0)]
    if others:
        lines.append(f"In view: {'; '.join(_runs(others)[:MOST_SHOWN])}.")
    sides = zip(view.walls, ("forward", "left", "right"), strict=True)
    walls = ", ".join(f"{steps} {side}" for steps, side in sides if steps)
    return "\n".join([*lines, f"Walls: {walls}."] if walls else lines)


def _runs(things: Sequence[Thing]) -> list[str]:
    """Names and places, nearest first; neighbours with one name become "lava 2 forward, 3 left to 1 right"."""
    left = list(things)
    said = []
    while left:
        first = left.pop(0)
        same = {(t.forward, t.right): t for t in left if t.name == first.name}
        best: list[Thing] = []
        for step in ((0, 1), (1, 0)):
            run = [first]
            for sign in (1, -1):
                place = (first.forward + sign * step[0], first.right + sign * step[1])
                while place in same:
                    run.append(same[place])
                    place = (place[0] + sign * step[0], place[1] + sign * step[1])
            if len(run) > len(best):
                best = sorted(run, key=lambda t: (t.forward, t.right))
        left = [t for t in left if t not in best]
        said.append(f"{first.name} {_span(best)}")
    return said


def _span(run: Sequence[Thing]) -> str:
    """Place of one thing, or of a straight row of them."""
    a, b = run[0], run[-1]
    if a == b:
        return a.place
    if a.forward == b.forward:
        ends = [f"{abs(t.right)} {'right' if t.right > 0 else 'left'}" if t.right else "straight" for t in (a, b)]
        return f"{a.forward} forward, {ends[0]} to {ends[1]}"
    side = f", {abs(a.right)} {'right' if a.right > 0 else 'left'}" if a.right else ""
    return f"{a.forward} to {b.forward} forward{side}"


def basic(view: View, last: str = "") -> str:
    """One sentence per thing seen."""
    lines = [f"Your mission: {view.mission}."]
    if last:
        lines.append(f"Your last action: {last}.")
    lines.append(f"You face {view.heading}. You carry {_article(view.carrying) if view.carrying else 'nothing'}.")
    for steps, side in zip(view.walls, ("in front of you", "to your left", "to your right"), strict=True):
        if steps:
            lines.append(f"There is a wall {_steps(steps)} {side}.")
    lines += [f"There is {_article(thing.name)} at {thing.place}." for thing in view.things]
    return "\n".join(lines)


def relational(view: View, last: str = "") -> str:
    """What the front cell affords, objects by distance, and the map."""
    front = view.ahead.name if view.ahead else "empty"
    lines = [f"Mission: {view.mission}."]
    if last:
        lines.append(f"Last action: {last}.")
    lines += [
        f"Heading: {view.heading}. Carrying: {view.carrying or 'nothing'}.",
        f"Cell in front: {front} (you can: {', '.join(view.affordances) or 'not enter it'}).",
        "Objects, nearest first:" if view.things else "No objects in view.",
        *(f"- {thing.name}: {thing.place} ({_steps(thing.distance)} away)" for thing in view.things),
        f"Map ({LEGEND}):",
        *view.rows,
    ]
    return "\n".join(lines)


TEXTS = {"compact": compact, "basic": basic, "relational": relational}
"""Text variant -> function of a `View` and what the last action did."""


def _article(name: str) -> str:
    return f"{'an' if name[:1] in 'aeiou' else 'a'} {name}"


def _steps(count: int) -> str:
    return f"{count} step{'' if count == 1 else 's'}"
