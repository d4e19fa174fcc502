"""How ALFRED is played: distances and camera, and bringing a world to where a trial starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agentspec.envs.alfred.trials import Trial
from agentspec.envs.thor.engine import OfflineThor, Settings
from agentspec.envs.thor.protocol import Thor
from agentspec.envs.thor.scene import Scene
from agentspec.envs.thor.sight import AGENT_HEIGHT, Camera

SETTINGS = Settings(look_step=15.0, horizon=(-30.0, 60.0), camera=Camera(AGENT_HEIGHT, 60.0))
"""ALFRED's: 0.25 m, 90 degrees, 15 degrees, 300 x 300 pixels, 1.5 m. Camera height and field of view are the build's
defaults; they also explain best where the recorded pictures show the objects that experts pick up."""


def start(trial: Trial, scene: Scene, settings: Settings = SETTINGS) -> OfflineThor:
    """An offline world set up for a trial; raises as `set_up`."""
    world = OfflineThor(scene, settings)
    set_up(world, trial)
    return world


def set_up(world: Thor, trial: Trial) -> None:
    """Bring a world to where a trial starts, in ALFRED's order: dirt, switches, objects, the agent.

    Raises:
        ValueError: the trial does not fit the scene.
    """
    todo: list[Mapping[str, Any]] = []
    if trial.dirty:
        todo += [
            {"action": "SetStateOfAllObjects", "StateChange": "CanBeDirty"},
            {"action": "SetStateOfAllObjects", "StateChange": "CanBeFilled"},
        ]
    todo += [
        {"action": "SetObjectToggles", "objectToggles": trial.toggles},
        {"action": "SetObjectPoses", "objectPoses": trial.poses},
        trial.start,
    ]
    for action in todo:
        event = world.step(action)
        if not event.success:
            raise ValueError(f"trial {trial.id} does not fit scene {trial.scene}: {action['action']}: {event.error}")
