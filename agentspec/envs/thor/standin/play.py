"""What the stand-in does with an action: set the offline world up as ai2thor's fields say, or step it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agentspec.envs.thor import homes, mining
from agentspec.envs.thor.engine import KNOWN, OfflineThor, Settings
from agentspec.envs.thor.scene import Scene
from agentspec.envs.thor.sight import ROBOT_HEIGHT, Camera

SUFFIX = "_physics"
"""What ai2thor's Controller appends to the names of household scenes."""


@dataclass(frozen=True)
class Scenes:
    """The scenes there are: the package's own, and those whose public data are in the folders given.

    Args:
        trials, objects, layouts, episodes: folders, or empty.
    """

    trials: str = ""
    objects: str = ""
    layouts: str = ""
    episodes: str = ""

    def names(self) -> list[str]:
        """As ai2thor lists them."""
        recorded = (
            {p.name.split(".")[0] for p in Path(self.objects).glob("FloorPlan*.json*")} if self.objects else set()
        )
        homesteads = [f"{n}{SUFFIX}" if n.removeprefix("FloorPlan").isdigit() else n for n in recorded]
        return sorted([*homes.ROOMS, homes.apartment().name, *homesteads])

    def get(self, name: str) -> Scene:
        """A scene by name.

        Raises:
            LookupError, OSError: there is none, or its data are not there.
        """
        plain = name.removesuffix(SUFFIX)
        if plain == homes.apartment().name:
            return homes.apartment()
        if plain in homes.ROOMS or not plain.startswith("FloorPlan"):
            return homes.room(plain)
        if plain.removeprefix("FloorPlan").isdigit():
            return mining.household(plain, self.trials, self.objects, self.layouts)
        return mining.apartment(plain, self.episodes, self.objects)


class StandIn:
    """The world and how it is shown.

    Args:
        scenes: what can be reset to.
        size: of pictures, (width, height) pixels.
    """

    def __init__(self, scenes: Scenes, size: tuple[int, int]) -> None:
        self._scenes = scenes
        self._settings = Settings(width=size[0], height=size[1])
        self._render = True
        self.world = OfflineThor(homes.apartment(), self._settings)

    def answer(self, action: Mapping[str, Any]) -> tuple[dict[str, Any], bytes | None]:
        """Metadata of the agent, and the picture's bytes (RGB, bottom row first) if pictures are wanted.

        Args:
            action: as the Controller sends it; without a name, the state is told.
        """
        name = str(action.get("action", ""))
        told: dict[str, Any] = {}
        try:
            if name in SETTING_UP:
                told["actionReturn"] = SETTING_UP[name](self, action)
                event = self.world.observe()
            else:
                event = self.world.step(action) if name else self.world.observe()
        except (LookupError, OSError, TypeError, ValueError) as error:
            event = self.world.observe()
            told |= {"lastActionSuccess": False, "errorMessage": str(error), "errorCode": "InvalidArgument"}
        told["lastAction"] = name
        if name and name not in KNOWN and name not in SETTING_UP:
            told["errorCode"] = "InvalidAction"
        s = self.world.settings
        told |= {"screenWidth": s.width, "screenHeight": s.height, "thirdPartyCameras": []}
        render = self._render and action.get("renderImage") is not False
        frame = np.flipud(event.frame).tobytes() if render and event.frame is not None else None
        return {**event.metadata, **told}, frame

    # -- what ai2thor's Controller does before an episode ------------------------------------------------------

    def _reset(self, action: Mapping[str, Any]) -> None:
        self.world = OfflineThor(self._scenes.get(str(action["sceneName"])), self._settings)

    def _initialize(self, action: Mapping[str, Any]) -> dict[str, float]:
        robot = str(action.get("agentMode", "default")).lower() == "locobot"
        old, reach = self.world.settings, float(action.get("visibilityDistance") or 1.5)
        view = float(action.get("fieldOfView") or Camera.field_of_view)
        camera = Camera(ROBOT_HEIGHT if robot else Camera.height, view, old.width / old.height)
        settings = replace(
            old,
            grid=float(action.get("gridSize") or old.grid),
            rotate_step=float(action.get("rotateStepDegrees") or 90.0),
            horizon=(-30.0, 60.0),
            visibility=reach,
            slack=reach if robot else old.slack,
            camera=camera,
        )
        self._render = action.get("renderImage") is not False
        self.world = OfflineThor(self.world.scene, settings)
        return {"cameraNearPlane": 0.1, "cameraFarPlane": 20.0}

    def _resize(self, action: Mapping[str, Any]) -> None:
        self._settings = replace(self._settings, width=int(action["x"]), height=int(action["y"]))
        self.world = OfflineThor(self.world.scene, self._settings)

    def _list(self, action: Mapping[str, Any]) -> list[str]:
        return self._scenes.names()


SETTING_UP: Mapping[str, Callable[[StandIn, Mapping[str, Any]], Any]] = {
    "Reset": StandIn._reset,
    "Initialize": StandIn._initialize,
    "ChangeResolution": StandIn._resize,
    "GetScenesInBuild": StandIn._list,
}
"""Action of the Controller -> what carries it out; the answer is the event's `actionReturn`."""
