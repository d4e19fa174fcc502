"""How RoboTHOR is played: as the AgentSpec paper says, as the challenge of 2021, or as the paper's printed trace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from agentspec.envs.thor.engine import Settings
from agentspec.envs.thor.sight import ROBOT_HEIGHT, Camera


@dataclass(frozen=True)
class Preset:
    """How it is played: the player's settings and the budget."""

    settings: Settings
    max_steps: int


def _preset(turn: float, fov: float, reach: float, steps: int, grid: float = 0.25, size: Any = (300, 300)) -> Preset:
    camera = Camera(ROBOT_HEIGHT, fov, size[0] / size[1])
    settings = Settings(
        grid=grid,
        rotate_step=turn,
        horizon=(-30.0, 60.0),
        visibility=reach,
        width=size[0],
        height=size[1],
        camera=camera,
        slack=reach,
    )
    return Preset(settings, steps)


PRESETS: dict[str, Preset] = {
    "paper": _preset(90.0, 90.0, 1.5, 200),
    "challenge2021": _preset(30.0, 63.453, 1.0, 500, size=(640, 480)),
    "casestudy": _preset(45.0, 90.0, 1.5, 200, grid=0.5),
}
