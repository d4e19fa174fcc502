"""What is played: a scene, a class of objects, a start, and the length of the shortest path.

Episodes are read from the challenge's files by path (`<scene>.json.gz`), or are our own in our own apartment. The ten
of `VALIDATION` are validation episodes spread over rooms, classes and lengths, all with a heading that is a multiple of
90 degrees (others would leave the grid for ever with turns of 90 degrees). The AgentSpec paper does not name its ten.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from agentspec.envs.thor.geodesic import distances
from agentspec.envs.thor.homes import apartment
from agentspec.envs.thor.mining import objects_file, read_json
from agentspec.envs.thor.scene import GRID, Cell, Scene
from agentspec.envs.thor.sight import Camera, Sight
from agentspec.envs.thor.state import place

VALIDATION: tuple[str, ...] = (
    "FloorPlan_Val2_1_Television_2",
    "FloorPlan_Val1_5_BasketBall_4",
    "FloorPlan_Val2_5_Vase_6",
    "FloorPlan_Val2_3_Laptop_8",
    "FloorPlan_Val1_1_GarbageCan_6",
    "FloorPlan_Val3_4_HousePlant_9",
    "FloorPlan_Val1_3_AlarmClock_6",
    "FloorPlan_Val2_4_Apple_5",
    "FloorPlan_Val3_5_BaseballBat_3",
    "FloorPlan_Val3_3_SprayBottle_2",
)
"""The fixed ten, from 1.0 m to 7.6 m."""

OWN: tuple[tuple[str, Cell, int], ...] = (
    ("Television", (7, 4), 180),
    ("Vase", (10, 4), 90),
    ("AlarmClock", (18, 5), 180),
    ("GarbageCan", (16, 9), 270),
    ("Laptop", (8, 8), 0),
    ("BaseballBat", (34, 4), 90),
    ("Apple", (22, 8), 270),
    ("SprayBottle", (32, 5), 0),
    ("BasketBall", (7, 6), 0),
    ("Bowl", (6, 8), 270),
)
"""Ten episodes in our apartment: class, start cell, heading."""


@dataclass(frozen=True)
class Episode:
    """One search.

    Args:
        id, scene, target: names; `target` is an object type.
        x, z, yaw, horizon: where the agent starts, metres and degrees.
        length: of the shortest path to where the target is seen, metres.
    """

    id: str
    scene: str
    target: str
    x: float
    z: float
    yaw: float
    horizon: float
    length: float


def read_episodes(folder: Path, scene: str) -> dict[str, Episode]:
    """The episodes of a scene's file, by id.

    Raises:
        NoData: there is no such file.
        ValueError: the file holds no episodes.
    """
    path = objects_file(folder, scene)
    try:
        found = {}
        for e in read_json(path):
            at = e["initial_position"]
            found[e["id"]] = Episode(
                e["id"],
                e["scene"],
                e["object_type"],
                float(at["x"]),
                float(at["z"]),
                float(e["initial_orientation"]),
                float(e["initial_horizon"]),
                float(e["shortest_path_length"]),
            )
        return found
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} holds no RoboTHOR episodes: {error!r}") from error


def scene_of(episode_id: str) -> str:
    """`FloorPlan_Val1_1_Apple_0` -> `FloorPlan_Val1_1`."""
    return "_".join(episode_id.split("_")[:3])


def nearest(scene: Scene, cell: Cell) -> Cell:
    """The cell of a scene nearest to a place."""
    return min(scene.cells, key=lambda c: (math.dist(c, cell), c))


@lru_cache(maxsize=8)
def own_episodes(reach: float, camera: Camera) -> tuple[Episode, ...]:
    """Ours, with the lengths of their shortest paths to where the target is seen within `reach` metres."""
    scene = apartment()
    sight = Sight(scene, camera, reach)
    state = place(scene)
    sight.refresh(state)
    made = []
    for number, (target, at, yaw) in enumerate(OWN):
        start = nearest(scene, at)
        bodies = [b for b in state.bodies.values() if b.type == target]
        goals = [c for c in scene.cells if any(sight.free(b, c[0] * GRID, c[1] * GRID) for b in bodies)]
        length = distances(goals, scene.cells)[0][start]
        made.append(
            Episode(f"own_{number}_{target}", scene.name, target, start[0] * GRID, start[1] * GRID, yaw, 30.0, length)
        )
    return tuple(made)
