"""A view of a grid in words, in three lengths: a line per aspect, a sentence per thing, or relations and a map."""

from __future__ import annotations

from collections.abc import Sequence

from agentspec.envs.minigrid.view import Thing, View

LEGEND = "you are ^ and look up; # wall, . free, ? unseen, D door, _ open door, K key, O ball, B box, G goal, L lava"
MOST_SHOWN = 3
"""Things, or rows of equal things, that the compact text names."""


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
