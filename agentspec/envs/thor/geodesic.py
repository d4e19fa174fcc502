"""Shortest ways over the cells of a scene: any-angle distances, and steps for an agent that turns and moves.

Distances are those of a walker who goes straight wherever the cells between allow it, as a navigation mesh measures
them: Dijkstra's search over neighbouring cells in which a cell's predecessor may be any cell in straight sight (Theta*;
Nash, Daniel, Koenig and Felner, 2007).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Iterable

from agentspec.envs.thor.scene import GRID, Cell

NEIGHBOURS: tuple[Cell, ...] = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))


def straight(a: Cell, b: Cell, cells: Collection[Cell]) -> bool:
    """Whether the straight line between two cells stays on `cells`.

    Looked at every half cell; a point exactly between two cells needs both.
    """
    steps = 2 * max(abs(a[0] - b[0]), abs(a[1] - b[1]))
    for i in range(1, steps):
        x, z = a[0] + (b[0] - a[0]) * i / steps, a[1] + (b[1] - a[1]) * i / steps
        for nx in {math.floor(x + 0.5), math.ceil(x - 0.5)}:
            for nz in {math.floor(z + 0.5), math.ceil(z - 0.5)}:
                if (nx, nz) not in cells:
                    return False
    return True


def distances(goals: Iterable[Cell], cells: Collection[Cell]) -> tuple[dict[Cell, float], dict[Cell, Cell]]:
    """Metres from every cell to the nearest of `goals`, and each cell's next corner on that way.

    Cells that reach no goal are missing; a goal is its own next corner. Goals outside `cells` are ignored.
    """
    best = {goal: 0.0 for goal in goals if goal in cells}
    towards = {goal: goal for goal in best}
    queue = [(0.0, goal) for goal in sorted(best)]
    done: set[Cell] = set()
    while queue:
        _, cell = heapq.heappop(queue)
        if cell in done:
            continue
        done.add(cell)
        for dx, dz in NEIGHBOURS:
            near = (cell[0] + dx, cell[1] + dz)
            if near in done or near not in cells:
                continue
            if dx and dz and not ({(cell[0] + dx, cell[1]), (cell[0], cell[1] + dz)} & cells):  # type: ignore[operator]
                continue
            corner = towards[cell] if straight(towards[cell], near, cells) else cell
            length = best[corner] + GRID * math.dist(corner, near)
            if length < best.get(near, math.inf) - 1e-9:
                best[near], towards[near] = length, corner
                heapq.heappush(queue, (length, near))
    return best, towards


def corners(start: Cell, towards: dict[Cell, Cell]) -> list[Cell]:
    """The corners of the way from `start` to its goal, both included; empty if there is none."""
    if start not in towards:
        return []
    way = [start]
    while towards[way[-1]] != way[-1]:
        way.append(towards[way[-1]])
    return way
