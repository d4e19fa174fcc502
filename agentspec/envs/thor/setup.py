"""What sets a world up rather than acts in it: teleporting, and placing and switching all objects at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from agentspec.envs.thor.kinds import kind
from agentspec.envs.thor.protocol import Refused
from agentspec.envs.thor.scene import cell_at, object_id
from agentspec.envs.thor.state import Body, settle

if TYPE_CHECKING:
    from agentspec.envs.thor.engine import OfflineThor

Action = Mapping[str, Any]


def teleport(world: OfflineThor, action: Action) -> None:
    """Stand at x, z (`position` or fields), with `rotation` and `horizon` where given."""
    agent = world.state.agent
    spot = action.get("position") or action
    x, z = float(spot.get("x", agent.x)), float(spot.get("z", agent.z))
    if cell_at(x, z) not in world.scene.cells:
        raise Refused(f"the agent cannot stand at x={x:g}, z={z:g}")
    turned = action.get("rotation", agent.yaw)
    yaw = float(turned["y"] if isinstance(turned, Mapping) else turned) % 360.0
    horizon = float(action.get("horizon", agent.horizon))
    low, high = world.settings.horizon
    if not low <= horizon <= high:
        raise Refused(f"horizon {horizon:g} is outside {low:g}..{high:g}")
    agent.x, agent.z, agent.yaw, agent.horizon = x, z, yaw, horizon
    agent.standing = bool(action.get("standing", True))


def set_object_poses(world: OfflineThor, action: Action) -> None:
    """Put movable objects where `objectPoses` says, and take those away that it does not name.

    Several poses of one name make several objects. Ids follow from the positions.
    """
    bodies = world.state.bodies
    models = {b.name: b for b in bodies.values()}
    by_type = {b.type: b for b in bodies.values()}
    fixed = {i: b for i, b in bodies.items() if "pickupable" not in b.abilities}
    posed: dict[str, Body] = {}
    for pose in action["objectPoses"]:
        name = str(pose["objectName"])
        type_name = name.partition("_")[0]
        model = models.get(name) or by_type.get(type_name)
        if model is not None and "pickupable" not in model.abilities:
            continue  # furniture that was recorded with the rest stays where the scene has it
        one = _posed(type_name, name, model, pose)
        posed[one.id] = one
    world.state.bodies = {**fixed, **posed}
    settle(world.state.bodies)
    world.touched()


def _posed(type_name: str, name: str, model: Body | None, pose: Mapping[str, Any]) -> Body:
    p = pose["position"]
    position = [float(p["x"]), float(p["y"]), float(p["z"])]
    yaw = float(pose.get("rotation", {}).get("y", 0.0)) % 360.0
    size = list(model.size if model else kind(type_name).size)
    offset = [c - q for c, q in zip(model.centre, model.position, strict=True)] if model else [0.0, size[1] / 2, 0.0]
    offset = offset if max(map(abs, offset)) < 0.5 else [0.0, size[1] / 2, 0.0]
    centre = [q + o for q, o in zip(position, offset, strict=True)]
    abilities = model.abilities if model else sorted(kind(type_name).abilities)
    made = Body(object_id(type_name, position), type_name, name, centre, size, position, yaw, abilities)
    made.open = bool(model and model.open) or (model is None and type_name == "Laptop")
    return made


def set_object_toggles(world: OfflineThor, action: Action) -> None:
    """Switch all objects of the types in `objectToggles` on or off."""
    for toggle in action["objectToggles"]:
        for one in world.state.bodies.values():
            if one.type == toggle["objectType"] and "toggleable" in one.abilities:
                one.on = bool(toggle["isOn"])
    world.touched()


def set_state_of_all(world: OfflineThor, action: Action) -> None:
    """`SetStateOfAllObjects`: everything that can be is made dirty, or empty."""
    change = str(action.get("StateChange", ""))
    for one in world.state.bodies.values():
        if change == "CanBeDirty":
            one.dirty = one.type in DIRTYABLE
        elif change == "CanBeFilled":
            one.filled = False
    world.touched()


DIRTYABLE = frozenset({"Bed", "Bowl", "Cloth", "Cup", "Mirror", "Mug", "Pan", "Plate", "Pot"})

ACTIONS: dict[str, Callable[[OfflineThor, Action], None]] = {
    "Teleport": teleport,
    "TeleportFull": teleport,
    "SetObjectPoses": set_object_poses,
    "SetObjectToggles": set_object_toggles,
    "SetStateOfAllObjects": set_state_of_all,
}
"""Action -> what carries it out."""
