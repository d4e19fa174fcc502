"""The list of visible objects: what the paper gives agents, as data and in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agentspec.envs.thor.names import Names, direction, whereabouts


def in_view(metadata: Mapping[str, Any], names: Names) -> list[dict[str, Any]]:
    """The objects in view, nearest first, as an observation's state tells them."""
    seen = []
    agent = metadata["agent"]
    for one in metadata["objects"]:
        if one["visible"] and not one["isPickedUp"]:
            far, bearing = whereabouts(one, agent)
            told: dict[str, Any] = {
                "name": names.name(one["objectId"]),
                "objectId": one["objectId"],
                "distance": round(far, 2),
                "bearing": bearing,
            }
            if one["openable"] and not one["pickupable"]:
                told["isOpen"] = one["isOpen"]
            if one["toggleable"]:
                told["isToggled"] = one["isToggled"]
            if one["pickupable"] and one["parentReceptacles"]:
                told["in"] = names.name(one["parentReceptacles"][0])
            seen.append(told)
    return sorted(seen, key=lambda t: (t["distance"], t["name"]))


def worded(told: Mapping[str, Any]) -> str:
    """One of `in_view` in words: `fridge 1 (closed) 0.8 m ahead`."""
    notes = []
    if "isOpen" in told:
        notes.append("open" if told["isOpen"] else "closed")
    if "isToggled" in told:
        notes.append("on" if told["isToggled"] else "off")
    if "in" in told:
        notes.append(f"in {told['in']}")
    extra = f" ({', '.join(notes)})" if notes else ""
    return f"{told['name']}{extra} {told['distance']} m {direction(told['bearing'])}"
