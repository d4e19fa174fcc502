"""The offline player: a household world of boxes on a grid, deterministic and in-process.

`OfflineThor.step` takes ai2thor's actions and answers with ai2thor's metadata. There is no physics: objects stay where
they are put, the agent stands on cells, and what cannot be done fails with a message. Moving and looking stand here,
what is done to objects in `manipulation`, what is seen in `sight`, pictures in `render`.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from agentspec.envs.thor import manipulation, setup
from agentspec.envs.thor.geodesic import corners, distances
from agentspec.envs.thor.metadata import catalogue, describe
from agentspec.envs.thor.protocol import Event, Picture, Refused
from agentspec.envs.thor.scene import GRID, Cell, Scene, cell_at
from agentspec.envs.thor.sight import Camera, Sight
from agentspec.envs.thor.state import Body, State, load, place


@dataclass(frozen=True)
class Settings:
    """How a world is played, with ai2thor's meanings.

    Args:
        grid: metres of a MoveAhead without `moveMagnitude`.
        rotate_step: degrees of RotateLeft and RotateRight without `degrees`.
        look_step: degrees of LookUp and LookDown without `degrees`.
        horizon: lowest and highest camera pitch, degrees downwards.
        visibility: metres within which objects are visible and can be reached.
        width, height: of pictures, pixels.
        camera: height and field of view.
        agent_height: the y of the agent's position, metres.
        slack: see `sight.Sight`.
        knife: whether slicing needs a knife in the hand.
    """

    grid: float = GRID
    rotate_step: float = 90.0
    look_step: float = 30.0
    horizon: tuple[float, float] = (-60.0, 60.0)
    visibility: float = 1.5
    width: int = 300
    height: int = 300
    camera: Camera = Camera()
    agent_height: float = 0.901
    slack: float = 1.0
    knife: bool = True


TURNS = {"RotateLeft": -1.0, "RotateRight": 1.0}
LOOKS = {"LookUp": -1.0, "LookDown": 1.0}
MOVES = {"MoveAhead": 0.0, "MoveRight": 90.0, "MoveBack": 180.0, "MoveLeft": 270.0}
NOTHING = frozenset({"Pass", "Done", "Stop", "Initialize", "ChangeResolution", "NoOp"})


class OfflineThor:
    """One world.

    Args:
        scene: where it plays.
        settings: see `Settings`.
        scenes: name -> scene, for the action `Reset`; without it only the first scene can be reset.
    """

    def __init__(
        self, scene: Scene, settings: Settings = Settings(), *, scenes: Callable[[str], Scene] | None = None
    ) -> None:
        self.settings = settings
        self._scenes = scenes
        self.begin(scene)

    def begin(self, scene: Scene) -> Event:
        """Start `scene` from its beginning."""
        self.scene = scene
        self.state = place(scene)
        self.sight = Sight(scene, self.settings.camera, self.settings.visibility, self.settings.slack)
        self._last = ("Initialize", True, "", None)
        self.touched()
        s = self.settings
        self._seen: dict[Any, Any] = scene.seen.setdefault((s.camera, s.visibility, s.slack, s.agent_height), {})
        return self.observe()

    # -- acting ------------------------------------------------------------------------------------------------

    def step(self, action: Mapping[str, Any]) -> Event:
        """Carry out one action with ai2thor's name and fields.

        Never raises for what an action asks: an unknown name, a missing field or an impossible wish is a failure in the
        metadata.
        """
        name = str(action.get("action", ""))
        try:
            result = self._act(name, action)
            self._last = (name, True, "", result)
        except Refused as refusal:
            self._last = (name, False, str(refusal), None)
        except (KeyError, TypeError, ValueError) as error:
            self._last = (name, False, f"{name} has missing or malformed fields ({error!r})", None)
        return self.observe()

    def boxes(self) -> OfflineThor:
        """This world itself."""
        return self

    def close(self) -> None:
        """Nothing is held."""

    def try_move(self, name: str) -> None:
        """A move or turn without an event, for searches; one that is blocked changes nothing."""
        with contextlib.suppress(Refused):
            self._act(name, {})

    def _act(self, name: str, action: Mapping[str, Any]) -> Any:
        if name in MOVES:
            return self._move(MOVES[name], float(action.get("moveMagnitude") or self.settings.grid))
        if name in TURNS:
            turn = TURNS[name] * float(action.get("degrees") or self.settings.rotate_step)
            self.state.agent.yaw = round((self.state.agent.yaw + turn) % 360.0, 6) % 360.0
            return None
        if name in LOOKS:
            return self._look(LOOKS[name] * float(action.get("degrees") or self.settings.look_step))
        if name in CHANGING:
            return CHANGING[name](self, action)
        if name in ASKING:
            return ASKING[name](self, action)
        raise Refused(f"there is no action {name!r}")

    def _move(self, turn: float, metres: float) -> None:
        agent = self.state.agent
        heading = math.radians(agent.yaw + turn)
        steps = max(1, round(metres / GRID))
        for i in range(1, steps + 1):
            x = agent.x + math.sin(heading) * metres * i / steps
            z = agent.z + math.cos(heading) * metres * i / steps
            if cell_at(x, z) not in self.scene.cells:
                raise Refused(f"something blocks the way {metres:g} m in that direction")
        agent.x, agent.z = round(x, 6), round(z, 6)

    def _look(self, degrees: float) -> None:
        low, high = self.settings.horizon
        horizon = self.state.agent.horizon + degrees
        if not low - 1e-6 <= horizon <= high + 1e-6:
            raise Refused(f"the camera cannot look further {'down' if degrees > 0 else 'up'}")
        self.state.agent.horizon = horizon

    def _reset(self, name: str) -> None:
        if name != self.scene.name:
            if self._scenes is None:
                raise Refused(f"there is no scene {name!r} here, only {self.scene.name!r}")
            try:
                self.begin(self._scenes(name))
                return
            except (LookupError, OSError) as error:
                raise Refused(f"there is no scene {name!r} ({error})") from error
        self.begin(self.scene)

    # -- ways --------------------------------------------------------------------------------------------------

    def _point(self, cell: Cell) -> dict[str, float]:
        return {"x": cell[0] * GRID, "y": self.settings.agent_height, "z": cell[1] * GRID}

    def _shortest_path(self, action: Mapping[str, Any]) -> dict[str, Any]:
        """Corners of the shortest way to a place from which an object is seen; `objectId` or `objectType`."""
        wanted = str(action.get("objectId") or action.get("objectType") or "")
        place = action.get("position") or self._point((0, 0)) | {"x": self.state.agent.x, "z": self.state.agent.z}
        x, z = float(place["x"]), float(place["z"])
        best, towards = self._way(wanted)
        first = _entry(best, x, z)
        if first is None:
            raise Refused(f"there is no way to a place from which {wanted!r} is seen")
        way = [self._point(c) for c in corners(first, towards)]
        if (way[0]["x"], way[0]["z"]) != (x, z):
            way = [way[0] | {"x": x, "z": z}, *way]
        return {"corners": way}

    def distance(self, target: str) -> float | None:
        """Metres on foot to where an object (id or type) is seen; None if there is no way."""
        best, (x, z) = self._way(target)[0], (self.state.agent.x, self.state.agent.z)
        first = _entry(best, x, z)
        return None if first is None else best[first] + math.dist((x, z), (first[0] * GRID, first[1] * GRID))

    def _way(self, wanted: str) -> tuple[dict[Cell, float], dict[Cell, Cell]]:
        """`geodesic.distances` to where an object is seen; searched once until an object changes."""
        if wanted in self.scene.sights:
            return self.scene.ways(wanted)
        if wanted not in self._ways:
            self._ways[wanted] = distances(self.viewpoints(wanted), self.scene.cells)
        return self._ways[wanted]

    def viewpoints(self, wanted: str) -> frozenset[Cell]:
        """The cells from which an object (id or type) is seen in some direction, whatever the agent does now.

        Where the scene records such cells (`Scene.sights`) those; else cells from which sight of it is free.
        """
        if wanted in self.scene.sights:
            return self.scene.sights[wanted]
        targets = [b for b in self.state.bodies.values() if wanted in (b.id, b.type)]
        return frozenset(c for c in self.scene.cells if any(self._seen_from(c, b) for b in targets))

    def near(self, cell: Cell, one: Body) -> bool:
        """Whether an object is within reach of a cell (as far as its box goes; it may be hidden)."""
        low, high = one.low, one.high
        x, z = cell[0] * GRID, cell[1] * GRID
        dx, dz = max(low[0] - x, 0.0, x - high[0]), max(low[2] - z, 0.0, z - high[2])
        return math.hypot(dx, dz) <= self.settings.visibility

    def _seen_from(self, cell: Cell, one: Body) -> bool:
        return self.near(cell, one) and self.sight.free(one, cell[0] * GRID, cell[1] * GRID)

    # -- reporting ---------------------------------------------------------------------------------------------

    def touched(self) -> None:
        """Objects moved, opened, appeared or vanished: what is cached of them is read again."""
        self.sight.refresh(self.state)
        self._objects = catalogue(self.state)
        self._places = np.array([b.position for b in self.state.bodies.values()]).reshape(-1, 3)
        self._index = {name: i for i, name in enumerate(self.state.bodies)}
        self._seen = {}
        self._ways: dict[str, tuple[dict[Cell, float], dict[Cell, Cell]]] = {}

    def sees(self, body: Body) -> bool:
        """Whether an object is visible to the agent now."""
        flags, _ = self._look_around()
        return bool(flags[self._index[body.id]])

    def _look_around(self) -> tuple[list[bool], list[float]]:
        """Per object whether it is visible, and its distance; cached by pose until an object changes."""
        agent = self.state.agent
        pose = (agent.x, agent.z, agent.yaw, agent.horizon)
        if pose not in self._seen:
            far = np.linalg.norm(self._places - (agent.x, self.settings.agent_height, agent.z), axis=1)
            self._seen[pose] = (self.sight.visible(agent).tolist(), far.tolist())
        found: tuple[list[bool], list[float]] = self._seen[pose]
        return found

    def observe(self) -> Event:
        """The present state as an event, without acting."""
        metadata = describe(self.state, self.settings, self._objects, self._look_around(), self._last)
        return Event(metadata, self._frame)

    def _frame(self) -> Picture:
        from agentspec.envs.thor.render import draw

        return draw(self.scene, self.state, self.settings)

    # -- exact state -------------------------------------------------------------------------------------------

    def snapshot(self) -> bytes:
        """The exact state."""
        return json.dumps({"state": self.state.dump(), "last": self._last}, separators=(",", ":")).encode()

    def restore(self, blob: bytes) -> Event:
        """Go back to a `snapshot` of this scene.

        Raises:
            ValueError: the bytes are no snapshot, or one of another scene.
        """
        data = json.loads(blob)
        state: State = load(data["state"])
        if state.scene != self.scene.name:
            raise ValueError(f"a snapshot of scene {state.scene!r} cannot be restored in {self.scene.name!r}")
        self.state = state
        self._last = tuple(data["last"])
        self.touched()
        return self.observe()


def _entry(best: Mapping[Cell, float], x: float, z: float) -> Cell | None:
    """The cell by which the way from a point begins: the point's own, or between cells the best of those around it.

    So nobody comes nearer by more than was walked.
    """
    i, j = cell_at(x, z)
    if (i * GRID, j * GRID) == (x, z):
        return (i, j) if (i, j) in best else None
    near = [(i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (i + a, j + b) in best]
    return min(near, key=lambda c: best[c] + math.dist((x, z), (c[0] * GRID, c[1] * GRID)), default=None)


CHANGING: Mapping[str, Callable[[OfflineThor, Mapping[str, Any]], None]] = {**manipulation.ACTIONS, **setup.ACTIONS}
ASKING: Mapping[str, Callable[[OfflineThor, Mapping[str, Any]], Any]] = {
    "GetShortestPath": OfflineThor._shortest_path,
    "GetReachablePositions": lambda world, action: [world._point(cell) for cell in sorted(world.scene.cells)],
    "GetScenesInBuild": lambda world, action: [world.scene.name],
    "Reset": lambda world, action: world._reset(str(action.get("sceneName") or world.scene.name)),
    **dict.fromkeys(NOTHING, lambda world, action: None),
}
"""Action -> what answers it; the answer is the event's `actionReturn`."""

KNOWN = frozenset({*MOVES, *TURNS, *LOOKS, *CHANGING, *ASKING})
"""The actions there are."""
