"""Sequences of primitives that bring an object into view: what `go to` and the scripted players are made of.

A pose is a cell, a heading in quarter turns and a camera pitch. Moves and turns are searched breadth-first; looking up
or down adds its steps at the end.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

from agentspec.envs.thor.engine import OfflineThor
from agentspec.envs.thor.scene import GRID, Cell, cell_at
from agentspec.envs.thor.state import Body

AHEAD: tuple[Cell, ...] = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""Cells one move ahead, by heading: north, east, south, west."""

Stand = tuple[int, int, int]
"""A cell and a heading in quarter turns."""


def stand(world: OfflineThor) -> Stand:
    """Where the agent stands now (its heading rounded to a quarter turn)."""
    agent = world.state.agent
    x, z = cell_at(agent.x, agent.z)
    return x, z, round(agent.yaw / 90) % 4


def reach(world: OfflineThor, start: Stand) -> Iterator[tuple[Stand, dict[Stand, tuple[Stand, str]]]]:
    """The stands in the order of the primitives they take, each with the predecessors found so far."""
    cells = world.scene.cells
    before: dict[Stand, tuple[Stand, str]] = {}
    seen = {start}
    queue = deque([start])
    while queue:
        now = queue.popleft()
        yield now, before
        x, z, heading = now
        dx, dz = AHEAD[heading]
        options = [((x + dx, z + dz, heading), "MoveAhead")] if (x + dx, z + dz) in cells else []
        options += [((x, z, (heading + 1) % 4), "RotateRight"), ((x, z, (heading - 1) % 4), "RotateLeft")]
        for near, name in options:
            if near not in seen:
                seen.add(near)
                before[near] = (now, name)
                queue.append(near)


def trace(end: Stand, before: dict[Stand, tuple[Stand, str]]) -> list[str]:
    """The primitives that lead to a stand."""
    way: list[str] = []
    while end in before:
        end, name = before[end]
        way.append(name)
    return way[::-1]


def way_to_see(world: OfflineThor, body: Body, *, limit: int = 400) -> list[str] | None:
    """The primitives after which an object is visible (nearly the fewest); [] if it is now, None if none is found.

    Args:
        world: with the agent where it is.
        body: the object.
        limit: primitives after which the search gives up.
    """
    if world.sees(body):
        return []
    spots = {c for c in world.scene.cells if world.near(c, body)}
    agent, step = world.state.agent, world.settings.look_step
    low, high = world.settings.horizon
    pitches = [agent.horizon + step * k for k in range(-9, 10) if low <= agent.horizon + step * k <= high]
    best: tuple[int, Stand, float, list[str]] | None = None
    lengths: dict[Stand, int] = {}
    for now, before in reach(world, stand(world)):
        lengths[now] = lengths[before[now][0]] + 1 if now in before else 0
        if (best is not None and lengths[now] >= best[0]) or lengths[now] > limit:
            break
        if (now[0], now[1]) not in spots:
            continue
        for pitch in sorted(pitches, key=lambda p: abs(p - agent.horizon)):
            cost = lengths[now] + round(abs(pitch - agent.horizon) / step)
            if best is not None and cost >= best[0]:
                break
            pose = replace(agent, x=now[0] * GRID, z=now[1] * GRID, yaw=90.0 * now[2], horizon=pitch)
            if world.sight.sees(body, pose):
                best = (cost, now, pitch, trace(now, before))
                break
    if best is None:
        return None
    _, _, pitch, way = best
    looks = round((pitch - agent.horizon) / step)
    return way + ["LookDown" if looks > 0 else "LookUp"] * abs(looks)
