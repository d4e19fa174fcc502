"""The metadata of an event, in ai2thor's field names, from a state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from agentspec.envs.thor.state import Body, State

if TYPE_CHECKING:
    from agentspec.envs.thor.engine import Settings

ABLE = ("pickupable", "receptacle", "openable", "toggleable", "sliceable", "moveable")


def _xyz(v: Any) -> dict[str, float]:
    return {"x": v[0], "y": v[1], "z": v[2]}


def catalogue(state: State) -> list[dict[str, Any]]:
    """The objects' metadata but for what depends on where the agent is; made again only when an object changed."""
    inside: dict[str, list[str]] = {}
    for body in state.bodies.values():
        for parent in body.parents:
            inside.setdefault(parent, []).append(body.id)
    return [_object(b, inside.get(b.id)) for b in state.bodies.values()]


def describe(
    state: State, settings: Settings, objects: list[dict[str, Any]], seen: Any, last: tuple[Any, ...]
) -> dict[str, Any]:
    """All of ai2thor's metadata that tasks read.

    Args:
        state: the world now.
        settings: of the player.
        objects: `catalogue(state)`; shared between events, copied shallowly.
        seen: a visibility flag and a distance per object, in order.
        last: action, whether it succeeded, its error, what it returned.
    """
    agent, action, held = state.agent, last, state.held()
    position = {"x": agent.x, "y": settings.agent_height, "z": agent.z}
    flags, far = seen
    return {
        "objects": [{**o, "visible": v, "distance": d} for o, v, d in zip(objects, flags, far, strict=True)],
        "agent": {
            "name": "agent",
            "position": position,
            "rotation": {"x": 0.0, "y": agent.yaw, "z": 0.0},
            "cameraHorizon": agent.horizon,
            "isStanding": agent.standing,
        },
        "inventoryObjects": [{"objectId": held.id, "objectType": held.type}] if held else [],
        "cameraPosition": {"x": agent.x, "y": settings.camera.height, "z": agent.z},
        "sceneName": state.scene,
        "fov": settings.camera.field_of_view,
        "screenWidth": settings.width,
        "screenHeight": settings.height,
        "lastAction": action[0],
        "lastActionSuccess": action[1],
        "errorMessage": action[2],
        "errorCode": "",
        "actionReturn": action[3],
        "reachablePositions": action[3] if action[0] == "GetReachablePositions" else [],
        "collided": action[0].startswith("Move") and not action[1],
        "isSceneAtRest": True,
        "agentId": 0,
        "colors": [],
        "colorBounds": [],
    }


def _object(b: Body, inside: list[str] | None) -> dict[str, Any]:
    able = b.abilities
    return {
        "objectId": b.id,
        "objectType": b.type,
        "name": b.name,
        "position": _xyz(b.position),
        "rotation": {"x": 0.0, "y": b.yaw, "z": 0.0},
        "distance": 0.0,
        "visible": False,
        "pickupable": "pickupable" in able,
        "receptacle": "receptacle" in able,
        "openable": "openable" in able,
        "toggleable": "toggleable" in able,
        "sliceable": "sliceable" in able,
        "moveable": "moveable" in able,
        "isOpen": b.open,
        "isToggled": b.on,
        "isPickedUp": b.held,
        "isSliced": b.sliced,
        "isDirty": b.dirty,
        "isFilledWithLiquid": b.filled,
        "parentReceptacles": list(b.parents) or None,
        "receptacleObjectIds": inside or [],
        "axisAlignedBoundingBox": {"center": _xyz(b.centre), "size": _xyz(b.size)},
    }
