"""What the agent sees: objects near enough, in the field of view, not shut away, and not behind something.

AI2-THOR calls an object visible when a point of it is within the visibility distance (horizontally), in the picture,
and not hidden. Here the points are a 3 x 3 x 3 grid over the object's box and the box's point nearest to the camera;
something hides a point if the segment from the camera to it passes through a wall or a large object's box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from agentspec.envs.thor.scene import Scene, cell_at
from agentspec.envs.thor.state import Agent, Body, State

Floats = npt.NDArray[np.float64]

BLOCKING = 0.12
"""Cubic metres: boxes at least this large hide what is behind them (a cupboard does, a plate does not)."""

SEE_THROUGH = frozenset(
    {
        "Floor",
        "Window",
        "Painting",
        "Mirror",
        "Blinds",
        "Curtains",
        "Shelf",
        "HousePlant",
        "Chair",
        "ShelvingUnit",
        "FloorLamp",
        "Desk",
        "DiningTable",
        "CoffeeTable",
        "SideTable",
        "TVStand",
        "ArmChair",
        "Sofa",
    }
)
"""Boxes that are mostly empty: one looks under a table, between the legs of a chair, over the seat of a sofa."""

AGENT_HEIGHT = 1.576
"""Metres: where ai2thor's default agent has its camera (0.901 m and 0.675 m above it)."""

ROBOT_HEIGHT = 0.87
"""Metres: the LoCoBot's camera; not verified against the simulator."""

_GRID = np.array([(x, y, z) for x in (-0.48, 0, 0.48) for y in (-0.48, 0, 0.48) for z in (-0.48, 0, 0.48)])


@dataclass(frozen=True)
class Camera:
    """Where pictures are taken from and how wide they are.

    Args:
        height: of the camera above the floor, metres.
        field_of_view: vertical, degrees.
        aspect: width over height of the picture.
    """

    height: float = AGENT_HEIGHT
    field_of_view: float = 60.0
    aspect: float = 1.0

    def eye(self, agent: Agent) -> Floats:
        """The camera's place, (3,) metres."""
        return np.array([agent.x, self.height, agent.z])

    def turn(self, agent: Agent) -> Floats:
        """The matrix from world directions to (right, up, forward) of the camera, (3, 3)."""
        s, c = math.sin(math.radians(agent.yaw)), math.cos(math.radians(agent.yaw))
        p, q = math.sin(math.radians(agent.horizon)), math.cos(math.radians(agent.horizon))
        return np.array([[c, 0.0, -s], [s * p, q, c * p], [s * q, -p, c * q]])

    @property
    def half(self) -> float:
        """The tangent of half the vertical field of view."""
        return math.tan(math.radians(self.field_of_view / 2))


class Sight:
    """Visibility in one scene; boxes are read again when `refresh` is called.

    Args:
        scene: its walls hide, its `sights` bound what is seen of some types.
        camera: see `Camera`.
        reach: the visibility distance, metres.
        slack: metres on foot from a known sight cell within which objects of `scene.sights` are seen.
    """

    def __init__(self, scene: Scene, camera: Camera, reach: float, slack: float = 1.0) -> None:
        self.camera, self.reach, self.slack = camera, reach, slack
        self._walls = [(np.array(c) - np.array(s) / 2, np.array(c) + np.array(s) / 2) for c, s in scene.walls]
        self._scene = scene

    def refresh(self, state: State) -> None:
        """Read the boxes of `state`: call it after objects moved, opened or appeared."""
        bodies = list(state.bodies.values())
        self._bodies = bodies
        self._low = np.array([b.low for b in bodies]).reshape(-1, 3)
        self._high = np.array([b.high for b in bodies]).reshape(-1, 3)
        shut = {b.id for b in bodies if b.closed or b.held}  # what is in something that is carried goes with it
        self._hidden = np.array([any(p in shut for p in b.parents) for b in bodies], bool)
        self._held = [i for i, b in enumerate(bodies) if b.held]
        self._before: dict[str, list[int]] = {}
        volume = np.prod(self._high - self._low, axis=1)
        self._blocking = [
            i for i, b in enumerate(bodies) if volume[i] >= BLOCKING and b.type not in SEE_THROUGH and not b.held
        ]

    def visible(self, agent: Agent) -> npt.NDArray[np.bool_]:
        """One flag per object, in the order of the state's objects."""
        eye, turn = self.camera.eye(agent), self.camera.turn(agent)
        nearest = np.clip(eye, self._low, self._high)
        flat = np.hypot(nearest[:, 0] - eye[0], nearest[:, 2] - eye[2])
        seen = np.zeros(len(flat), bool)
        candidates = np.flatnonzero((flat <= self.reach) & ~self._hidden)
        if len(candidates):
            seen[candidates] = self._in_picture(candidates, nearest, eye, turn, agent)
        seen[self._held] = True
        return seen

    def sees(self, one: Body, agent: Agent) -> bool:
        """Whether one object would be visible to the agent at a pose."""
        k = next(i for i, b in enumerate(self._bodies) if b.id == one.id)
        if one.held or self._hidden[k]:
            return bool(one.held)
        eye, turn = self.camera.eye(agent), self.camera.turn(agent)
        which = np.array([k])
        nearest = np.clip(eye, self._low, self._high)
        return bool(self._in_picture(which, nearest, eye, turn, agent)[0])

    def _in_picture(
        self, which: npt.NDArray[np.intp], nearest: Floats, eye: Floats, turn: Floats, agent: Agent
    ) -> Floats:
        low, high = self._low[which], self._high[which]
        grid = ((low + high) / 2)[:, None] + _GRID * (high - low)[:, None]
        points = np.concatenate([grid, nearest[which][:, None]], axis=1)
        local = (points - eye) @ turn.T
        half = self.camera.half
        ahead = np.maximum(local[..., 2], 1e-6)
        shown = (
            (local[..., 2] > 0.02)
            & (np.abs(local[..., 0]) <= ahead * half * self.camera.aspect)
            & (np.abs(local[..., 1]) <= ahead * half)
            & (np.hypot(points[..., 0] - eye[0], points[..., 2] - eye[2]) <= self.reach)
        )
        found = shown.any(axis=1)
        for k in np.flatnonzero(found):
            one = self._bodies[which[k]]
            found[k] = self._walkable(one, agent) and self._clear(one, points[k][shown[k]], eye)
        return found

    def _walkable(self, one: Body, agent: Agent) -> bool:
        if one.type not in self._scene.sights:
            return True
        return self._scene.ways(one.type)[0].get(cell_at(agent.x, agent.z), math.inf) <= self.slack + 1e-9

    def _clear(self, one: Body, points: Floats, eye: Floats) -> bool:
        """Whether one of the points is hidden by nothing: not by walls, nor by large boxes it is no part of."""
        hidden = np.zeros(len(points), bool)
        for low, high in self._walls:
            hidden |= crosses(eye, points, low, high)
        for i in self._blockers(one):
            low, high = self._low[i], self._high[i]
            if low[0] <= eye[0] <= high[0] and low[2] <= eye[2] <= high[2]:
                continue
            hidden |= crosses(eye, points, low, high)
            if hidden.all():
                return False
        return not hidden.all()

    def _blockers(self, one: Body) -> list[int]:
        """Numbers of the large boxes that an object is no part of; found once until an object changes."""
        if one.id not in self._before:
            others = ((i, self._bodies[i]) for i in self._blocking)
            apart = [i for i, b in others if b.id != one.id and b.id not in one.parents and not self._touch(b, one)]
            self._before[one.id] = apart
        return self._before[one.id]

    def free(self, one: Body, x: float, z: float) -> bool:
        """Whether an object can be seen from (x, z), looking anywhere: nothing is closed around it or before it."""
        eye = np.array([x, self.camera.height, z])
        low, high = np.array(one.low), np.array(one.high)
        points = np.concatenate([(low + high) / 2 + _GRID * (high - low), np.clip(eye, low, high)[None]])
        points = points[np.hypot(points[:, 0] - x, points[:, 2] - z) <= self.reach]
        shut = any(b.closed for b in self._bodies if b.id in one.parents)
        return not shut and len(points) > 0 and self._clear(one, points, eye)

    @staticmethod
    def _touch(a: Body, b: Body) -> bool:
        """Whether two boxes meet: drawers in a desk, a sink in a counter."""
        return all(abs(a.centre[i] - b.centre[i]) <= (a.size[i] + b.size[i]) / 2 + 0.02 for i in range(3))


def crosses(eye: Floats, points: Floats, low: Floats, high: Floats) -> npt.NDArray[np.bool_]:
    """Which segments from `eye` (3,) to `points` (n, 3) pass through the box (slab test); touching is not passing."""
    way = points - eye
    safe = np.where(np.abs(way) < 1e-9, 1e-9, way)
    a, b = (low - eye) / safe, (high - eye) / safe
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    result: npt.NDArray[np.bool_] = (enter < leave - 1e-6) & (leave > 1e-6) & (enter < 1 - 1e-3)
    return result
