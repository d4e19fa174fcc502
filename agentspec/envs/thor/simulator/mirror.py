"""A world of boxes made from a simulator's metadata, to plan ways in: what `go to` and menus need of any player."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from agentspec.envs.thor.engine import OfflineThor, Settings
from agentspec.envs.thor.kinds import kind
from agentspec.envs.thor.metadata import ABLE
from agentspec.envs.thor.scene import Cell, Scene, Thing, cell_at

DEFAULTS: dict[str, Any] = {
    "isOpen": False,
    "isToggled": False,
    "isPickedUp": False,
    "isSliced": False,
    "isDirty": False,
    "isFilledWithLiquid": False,
    "parentReceptacles": None,
    "receptacleObjectIds": [],
    "distance": 0.0,
    "rotation": {"x": 0.0, "y": 0.0, "z": 0.0},
    **dict.fromkeys(ABLE, False),
}
"""Fields of an object that some builds leave out."""


def complete(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Metadata with the fields that tasks read, also where an older build does not send them.

    Builds before 2.3 send no boxes: there an object gets its type's usual size, standing on its position.
    """
    held = {o["objectId"] for o in metadata.get("inventoryObjects") or ()}
    objects = []
    for one in metadata["objects"]:
        told = {**DEFAULTS, **one}
        told["receptacleObjectIds"] = told["receptacleObjectIds"] or []
        told["isPickedUp"] = told["isPickedUp"] or told["objectId"] in held
        if not told.get("axisAlignedBoundingBox"):
            w, h, d = kind(told["objectType"]).size
            p = told["position"]
            centre = {"x": p["x"], "y": p["y"] + h / 2, "z": p["z"]}
            told["axisAlignedBoundingBox"] = {"center": centre, "size": {"x": w, "y": h, "z": d}}
        objects.append(told)
    return {"actionReturn": None, "errorCode": "", **metadata, "objects": objects}


def mirror(metadata: Mapping[str, Any], cells: Iterable[Cell], settings: Settings) -> OfflineThor:
    """The world that metadata (`complete`) describe, with the agent where it is; walls are not known."""
    things = tuple(_thing(o) for o in metadata["objects"])
    agent = metadata["agent"]
    at = cell_at(agent["position"]["x"], agent["position"]["z"])
    world = OfflineThor(Scene(str(metadata["sceneName"]), frozenset({*cells, at}), things), settings)
    for one in metadata["objects"]:
        body = world.state.bodies[one["objectId"]]
        body.held, body.sliced = bool(one["isPickedUp"]), bool(one["isSliced"])
        body.parents = [p for p in one["parentReceptacles"] or () if p in world.state.bodies]
    here = world.state.agent
    here.x, here.z = agent["position"]["x"], agent["position"]["z"]
    here.yaw, here.horizon = agent["rotation"]["y"], agent["cameraHorizon"]
    world.touched()
    return world


def _thing(one: Mapping[str, Any]) -> Thing:
    box, at = one["axisAlignedBoundingBox"], one["position"]
    return Thing(
        one["objectId"],
        one["objectType"],
        (box["center"]["x"], box["center"]["y"], box["center"]["z"]),
        (max(box["size"]["x"], 0.01), max(box["size"]["y"], 0.01), max(box["size"]["z"], 0.01)),
        (at["x"], at["y"], at["z"]),
        str(one.get("name", "")),
        float(one["rotation"]["y"]) % 360.0,
        frozenset(a for a in ABLE if one[a]),
        open=bool(one["isOpen"]),
        on=bool(one["isToggled"]),
    )
