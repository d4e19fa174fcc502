"""The actions of ALFRED agents: native calls with an object's name, and the menu of what makes sense now."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from agentspec.envs.thor.kinds import KNIVES
from agentspec.envs.thor.manipulation import find
from agentspec.envs.thor.protocol import Refused
from agentspec.envs.thor.ways import way_to_see
from agentspec.types import Action, ActionSchema, ActionSpec, Parameter

if TYPE_CHECKING:
    from agentspec.envs.alfred.env import AlfredEnv

PLAIN = {
    "MOVE_AHEAD": ("MoveAhead", "move 0.25 m ahead", "moved ahead"),
    "ROTATE_LEFT": ("RotateLeft", "turn 90 degrees to the left", "turned left"),
    "ROTATE_RIGHT": ("RotateRight", "turn 90 degrees to the right", "turned right"),
    "LOOK_UP": ("LookUp", "tilt the camera up by 15 degrees", "looked up"),
    "LOOK_DOWN": ("LookDown", "tilt the camera down by 15 degrees", "looked down"),
}
"""Native call -> the player's action, what it does, what is said of it."""

ON_OBJECT = {
    "PICKUP": ("PickupObject", "take an object in view into the empty hand", "took", "apple 1"),
    "PUT": ("PutObject", "put what you hold into or onto a receptacle in view", "put it in or on", "counter top 1"),
    "OPEN": ("OpenObject", "open something in view", "opened", "fridge 1"),
    "CLOSE": ("CloseObject", "close something in view", "closed", "fridge 1"),
    "TOGGLE_ON": ("ToggleObjectOn", "switch something in view on", "switched on", "microwave 1"),
    "TOGGLE_OFF": ("ToggleObjectOff", "switch something in view off", "switched off", "microwave 1"),
    "SLICE": ("SliceObject", "slice an object in view with the knife you hold", "sliced", "apple 1"),
}
"""Native call -> the player's action, what it does, what is said of it, an example's object."""

PHRASES = {
    "take": "PICKUP",
    "open": "OPEN",
    "close": "CLOSE",
    "switch on": "TOGGLE_ON",
    "switch off": "TOGGLE_OFF",
    "slice": "SLICE",
    "put it in": "PUT",
}
"""Words of the menu before an object's name -> native call."""

LOOK = {
    "turn left": "ROTATE_LEFT",
    "turn right": "ROTATE_RIGHT",
}


def _schema() -> ActionSchema:
    actions = {name: ActionSpec(name, what, {}, f"{name}()") for name, (_, what, _) in PLAIN.items()}
    thing = {"object": Parameter("str")}
    for name, (_, what, _, example) in ON_OBJECT.items():
        actions[name] = ActionSpec(name, what, thing, f'{name}("{example}")')
    actions["STOP"] = ActionSpec("STOP", "say that the task is done; this ends the episode", {}, "STOP()")
    aliases = {ours[0].upper(): name for name, ours in {**PLAIN, **ON_OBJECT}.items()}
    return ActionSchema(actions, {**aliases, "DONE": "STOP", "TAKE": "PICKUP"})


NATIVE = _schema()
"""ALFRED's low-level actions."""


def choices(env: AlfredEnv) -> tuple[str, ...]:
    """What makes sense now: what can be done with things in view, where one can go, and `stop`."""
    if env.truncated or env._over():
        return ("stop",)
    metadata, names = env.event.metadata, env.names
    held = metadata["inventoryObjects"]
    found: list[str] = []
    ways: list[str] = []
    for one in sorted(metadata["objects"], key=lambda o: names.name(o["objectId"])):
        name = names.name(one["objectId"])
        if one["isPickedUp"]:
            continue
        if one["visible"]:
            found += [f"{verb} {name}" for verb in _verbs(one, held)]
        elif _worth_a_way(one, one["objectId"] in env.known) and env.reachable(one):
            ways.append(f"go to {name}")
    return (*found, *ways, *LOOK, "stop")


def _verbs(one: Any, held: Any) -> list[str]:
    verbs = []
    fixed = not one["pickupable"]
    if one["pickupable"] and not held:
        verbs.append("take")
    if one["receptacle"] and held and (one["isOpen"] or not one["openable"] or not fixed):
        verbs.append("put it in")
    if one["openable"] and fixed and not (one["objectType"] == "Microwave" and one["isToggled"]):
        verbs.append("close" if one["isOpen"] else "open")
    if one["toggleable"] and not (one["objectType"] == "Microwave" and one["isOpen"]):
        verbs.append("switch off" if one["isToggled"] else "switch on")
    knife = held and held[0]["objectType"] in KNIVES
    if one["sliceable"] and (knife or one["objectType"] == "Egg"):
        verbs.append("slice")
    return verbs


def _worth_a_way(one: Any, known: bool) -> bool:
    """Furniture one can use, and things that were seen."""
    usable = one["receptacle"] or one["openable"] or one["toggleable"]
    if one["pickupable"]:
        return known or not one["parentReceptacles"]  # what stands on the floor needs no search
    return usable and one["objectType"] not in ("Floor", "LightSwitch", "StoveKnob")


def carry_out(env: AlfredEnv, action: Action) -> tuple[str, str, str]:
    """Do a parsed action; returns message, error and code (one of message and error is empty)."""
    name = action.name
    if name in LOOK:
        name = LOOK[name]
    if name in ("STOP", "stop"):
        env.act({"action": "Stop"})
        env.stopped = True
        return "you said that the task is done", "", ""
    if name in PLAIN:
        event = env.act({"action": PLAIN[name][0]})
        return (PLAIN[name][2], "", "") if event.success else ("", event.error, "failed")
    if name.startswith("go to "):
        return _go(env, name.removeprefix("go to "))
    for phrase, native in PHRASES.items():
        if name.startswith(phrase + " "):
            return _use(env, native, name.removeprefix(phrase + " "))
    given = [*action.args, *action.kwargs.values()]
    return _use(env, name, str(given[0]) if given else "")


def _use(env: AlfredEnv, native: str, text: str) -> tuple[str, str, str]:
    command, _, said, example = ON_OBJECT[native]
    if not text:
        env.act({"action": "Pass"})
        return "", f'{native} needs the name of an object, as in {native}("{example}")', "missing_argument"
    object_id = env.names.id(text)
    held = env.event.metadata["inventoryObjects"]
    fields: dict[str, Any] = {"action": command, "objectId": object_id}
    if native == "PUT":
        fields = {"action": command, "objectId": held[0]["objectId"] if held else "", "receptacleObjectId": object_id}
        fields |= {"forceAction": True, "placeStationary": True}
    event = env.act(fields)
    if event.success:
        return f"{said} {env.names.name(object_id)}", "", ""
    error = event.error
    for one in sorted({object_id, *(h["objectId"] for h in held)}, key=len, reverse=True):
        error = error.replace(one, env.names.name(one))
    return "", error, "failed"


def _go(env: AlfredEnv, name: str) -> tuple[str, str, str]:
    try:
        boxes = env.world.boxes()
        way = way_to_see(boxes, find(boxes, env.names.id(name)))
    except Refused as refusal:
        way, name = None, f"{name} ({refusal})"
    if not way:
        env.act({"action": "Pass"})
        return (
            ("", f"there is no way to see {name} from here", "no_way") if way is None else (f"{name} is here", "", "")
        )
    walked = 0
    for command in way[: env.left]:
        env.act({"action": command})
        walked += 1
        if env._over():
            break
    arrived = "went to" if walked == len(way) else "was on the way to"
    return f"{arrived} {name}, {walked} steps", "", ""
