"""ai2thor's Controller as a player: the same actions and metadata as the offline world, from the simulator.

The Controller starts with the first scene and stays for all episodes. There is no way to save a simulator's state, so a
snapshot is the actions since the scene began, and restoring plays them again: exact as far as the simulator is
deterministic.
"""

from __future__ import annotations

import json
import math
import weakref
from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from agentspec.envs.thor.engine import OfflineThor, Settings
from agentspec.envs.thor.protocol import Event
from agentspec.envs.thor.scene import Cell, cell_at
from agentspec.envs.thor.simulator.links import LINKS, Link
from agentspec.envs.thor.simulator.mirror import complete, mirror
from agentspec.envs.thor.standin.launch import Script, write_executable

STANDIN = "standin"
"""As `executable`: the offline world behind ai2thor's protocol."""


class Ai2Thor:
    """The simulator; `begin` a scene before anything else.

    Args:
        version: of ai2thor, `2.1.0` or `5.0.0`.
        settings: distances, turns and picture size.
        executable: a program instead of ai2thor's own build, or `standin`.
        pictures: whether to render.
        folders: for the stand-in, where public data are: `trials`, `objects`, `layouts`, `episodes`.

    Raises:
        NoSimulator: it cannot be started.
    """

    def __init__(
        self,
        version: str,
        settings: Settings,
        *,
        executable: str = "",
        pictures: bool = True,
        folders: Mapping[str, str] | None = None,
    ) -> None:
        self.settings = settings
        self._made_of = (version, settings, executable, pictures, dict(folders or {}))
        script = write_executable(folders or {}) if executable == STANDIN else None
        program = script.path if script else executable
        self._link: Link = LINKS[version](settings, program, pictures, needs_display=script is None)
        self._end = weakref.finalize(self, _end, self._link, script)
        self.scene = ""
        self._history: list[dict[str, Any]] = []
        self._event: Event | None = None
        self._boxes: OfflineThor | None = None

    def begin(self, scene: str) -> Event:
        """Start `scene` from its beginning."""
        self.scene, self._history = scene, []
        event = self._take(self._link.begin(scene), "Initialize")
        asked = self._link.step({"action": "GetReachablePositions"}).metadata
        found = asked.get("actionReturn") or asked.get("reachablePositions") or []
        self._cells: frozenset[Cell] = frozenset(cell_at(p["x"], p["z"]) for p in found)
        return event

    def step(self, action: Mapping[str, Any]) -> Event:
        """Carry out one action."""
        sent = dict(action)
        name = str(sent.setdefault("action", ""))
        self._history.append(sent)
        try:
            raw = self._link.step(dict(sent))
        except ValueError as error:  # ai2thor's answer to an action it does not know
            return self._refused(name, str(error))
        return self._take(raw, name)

    def _take(self, raw: Any, name: str) -> Event:
        """An event of ai2thor's as one of ours."""
        told = complete(raw.metadata)
        told["lastAction"] = name
        if not told["lastActionSuccess"] and not told.get("errorMessage"):
            told["errorMessage"] = f"the simulator refused {name}"
        frame = None if raw.frame is None else np.ascontiguousarray(raw.frame, dtype=np.uint8)
        self._event = Event(told, None if frame is None else partial(np.asarray, frame))
        self._boxes = None
        return self._event

    def _refused(self, name: str, why: str) -> Event:
        before = self.observe()
        told = {**before.metadata, "lastAction": name, "lastActionSuccess": False, "errorMessage": why}
        self._event = Event(told, before.draw)
        return self._event

    def observe(self) -> Event:
        """The event of the last step."""
        if self._event is None:
            raise RuntimeError("begin a scene before anything else")
        return self._event

    def boxes(self) -> OfflineThor:
        """What the metadata tell, as a world of boxes."""
        if self._boxes is None:
            self._boxes = mirror(self.observe().metadata, self._cells, self.settings)
        return self._boxes

    def distance(self, target: str) -> float | None:
        """What the simulator's own shortest path measures; not a step of the episode."""
        asked: dict[str, Any] = {"action": "GetShortestPath", "objectType": target}
        asked["position"] = dict(self.observe().metadata["agent"]["position"])
        try:
            told = self._link.step(asked).metadata
        except ValueError:
            return None
        corners = (told.get("actionReturn") or {}).get("corners") or []
        if not told["lastActionSuccess"] or not corners:
            return None
        return sum(math.hypot(b["x"] - a["x"], b["z"] - a["z"]) for a, b in pairwise(corners))

    def snapshot(self) -> bytes:
        """The scene and the actions since it began."""
        return json.dumps({"scene": self.scene, "history": self._history}, separators=(",", ":")).encode()

    def restore(self, blob: bytes) -> Event:
        """Play a snapshot's actions again; if they go on from where this is, only those that are missing."""
        data = json.loads(blob)
        if data["scene"] != self.scene:
            raise ValueError(f"a snapshot of scene {data['scene']!r} cannot be restored in {self.scene!r}")
        history = data["history"]
        if self._history != history[: len(self._history)]:
            self.begin(self.scene)
        for action in history[len(self._history) :]:
            self.step(action)
        return self.observe()

    def close(self) -> None:
        """End the simulator."""
        self._end()

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is another simulator, brought to the same place."""
        return _again, (self._made_of, self.scene, list(self._history))


def _again(made_of: tuple[Any, ...], scene: str, history: list[dict[str, Any]]) -> Ai2Thor:
    version, settings, executable, pictures, folders = made_of
    player = Ai2Thor(version, settings, executable=executable, pictures=pictures, folders=folders)
    if scene:
        player.begin(scene)
    for action in history:
        player.step(action)
    return player


def _end(link: Link, script: Script | None) -> None:
    link.stop()
    if script is not None:
        script.remove()
