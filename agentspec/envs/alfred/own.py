"""Tasks of our own in our own rooms (`agentspec.envs.thor.homes`): every task type, with and without slicing.

A seed picks one of `TASKS` and lays things out: what is wanted, decoys, and where the agent starts.
"""

from __future__ import annotations

import random
from functools import lru_cache

from agentspec.envs.alfred.trials import Targets, Trial
from agentspec.envs.thor.homes import room
from agentspec.envs.thor.kinds import kind
from agentspec.envs.thor.names import words
from agentspec.envs.thor.scene import GRID, Thing

# type, room, what is wanted
TASKS: tuple[tuple[str, str, Targets], ...] = (
    ("pick_and_place_simple", "Kitchen1", Targets("SaltShaker", "DiningTable")),
    ("pick_two_obj_and_place", "LivingRoom1", Targets("Pillow", "Sofa")),
    ("pick_heat_then_place_in_recep", "Kitchen1", Targets("Potato", "DiningTable")),
    ("pick_cool_then_place_in_recep", "Kitchen1", Targets("Tomato", "CounterTop")),
    ("pick_clean_then_place_in_recep", "Kitchen1", Targets("Plate", "Cabinet")),
    ("look_at_obj_in_light", "Bedroom1", Targets("CellPhone", toggle="DeskLamp")),
    ("pick_and_place_with_movable_recep", "LivingRoom1", Targets("KeyChain", "ArmChair", "Box")),
    ("pick_and_place_simple", "Kitchen1", Targets("Lettuce", "CounterTop", sliced=True)),
    ("pick_two_obj_and_place", "Kitchen1", Targets("Apple", "DiningTable", sliced=True)),
    ("pick_heat_then_place_in_recep", "Kitchen1", Targets("Bread", "CounterTop", sliced=True)),
    ("pick_cool_then_place_in_recep", "Kitchen1", Targets("Apple", "DiningTable", sliced=True)),
    ("pick_clean_then_place_in_recep", "Kitchen1", Targets("Potato", "Microwave", sliced=True)),
    ("look_at_obj_in_light", "LivingRoom1", Targets("Book", toggle="FloorLamp")),
    ("pick_and_place_with_movable_recep", "Kitchen1", Targets("Tomato", "DiningTable", "Plate", sliced=True)),
    ("pick_and_place_simple", "Bedroom1", Targets("Book", "Bed")),
    ("pick_two_obj_and_place", "Bedroom1", Targets("CD", "Desk")),
)

DECOYS = {
    "Kitchen1": ("Mug", "Fork", "Bowl", "Egg", "PepperShaker", "Spoon"),
    "LivingRoom1": ("RemoteControl", "Vase", "Newspaper", "CreditCard", "Statue"),
    "Bedroom1": ("Pencil", "AlarmClock", "Pillow", "Watch", "Pen"),
}
SURFACES = frozenset(
    {"CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Dresser", "Desk", "TVStand", "Bed", "Sofa", "ArmChair"}
)
CLOSETS = frozenset({"Drawer", "Cabinet", "Fridge", "Safe"})


@lru_cache(maxsize=512)
def own_trial(seed: int) -> Trial:
    """The task and layout of a seed; seeds below `len(TASKS)` give every task once."""
    task_type, scene_name, targets = TASKS[seed % len(TASKS)]
    rng = random.Random(f"own task {seed}")
    scene = room(scene_name)
    copies = 2 if task_type == "pick_two_obj_and_place" and not targets.sliced else 1
    wanted = [targets.object] * copies + ([targets.movable] if targets.movable else [])
    wanted += ["Knife"] if targets.sliced else []
    layout = _Layout(scene.things, rng)
    for name in wanted:
        layout.put(name, closets=name not in ("Knife", targets.movable), avoid=targets.parent)
    for name in DECOYS[scene_name]:
        if name not in wanted:
            layout.put(name, closets=True, avoid="")
    cell = rng.choice(sorted(scene.cells))
    start = {
        "action": "TeleportFull",
        "x": cell[0] * GRID,
        "y": 0.901,
        "z": cell[1] * GRID,
        "rotation": rng.choice((0, 90, 180, 270)),
        "horizon": 30,
        "rotateOnTeleport": True,
    }
    lamps = ({"objectType": targets.toggle, "isOn": False},) if targets.toggle else ()
    sentence = instruction(task_type, targets)
    return Trial(f"own_{seed}", task_type, scene_name, sentence, targets, tuple(layout.poses), start, lamps)


class _Layout:
    """Puts objects on and into furniture, apart from each other."""

    def __init__(self, things: tuple[Thing, ...], rng: random.Random) -> None:
        self._things, self._rng = things, rng
        self._taken: list[tuple[float, float, float]] = []
        self.poses: list[dict[str, object]] = []

    def put(self, type_name: str, *, closets: bool, avoid: str) -> None:
        width, _, depth = kind(type_name).size
        for _ in range(500):
            on = self._rng.choice(self._things)
            fits = on.size[0] > width + 0.06 and on.size[2] > depth + 0.06
            shut = on.type in CLOSETS and closets and self._rng.random() < 0.4
            if on.type == avoid or not fits or not (on.type in SURFACES or shut):
                continue
            x = on.centre[0] + (self._rng.random() - 0.5) * (on.size[0] - width - 0.08)
            z = on.centre[2] + (self._rng.random() - 0.5) * (on.size[2] - depth - 0.08)
            bottom = on.centre[1] - on.size[1] / 2
            y = bottom + 0.04 if shut else bottom + on.size[1]
            if self._free(on, x, y, z, width, depth):
                self._taken.append((x, z, max(width, depth)))
                place = {"x": round(x, 4), "y": round(y, 4), "z": round(z, 4)}
                turn = {"x": 0.0, "y": 0.0, "z": 0.0}
                name = f"{type_name}_{len(self.poses)}"
                self.poses.append({"objectName": name, "position": place, "rotation": turn})
                return
        raise ValueError(f"no room is left for {type_name}")

    def _free(self, on: Thing, x: float, y: float, z: float, width: float, depth: float) -> bool:
        size = max(width, depth)
        if any(abs(x - a) < (s + size) / 2 and abs(z - b) < (s + size) / 2 for a, b, s in self._taken):
            return False
        return not any(
            t.id != on.id
            and t.centre[1] + t.size[1] / 2 > y + 0.01
            and t.centre[1] - t.size[1] / 2 < y + 0.3
            and abs(x - t.centre[0]) < (t.size[0] + width) / 2
            and abs(z - t.centre[2]) < (t.size[2] + depth) / 2
            for t in self._things
            if on.type not in CLOSETS
        )


def instruction(task_type: str, targets: Targets) -> str:
    """A sentence of ours for a task."""
    what = ("slice of " if targets.sliced else "") + words(targets.object)
    where = words(targets.parent)
    into = "in" if targets.parent in CLOSETS | {"Microwave", "GarbageCan"} else "on"
    return {
        "pick_and_place_simple": f"Put a {what} {into} the {where}.",
        "pick_two_obj_and_place": f"Put two of these {into} the same {where}: {what}.",
        "pick_heat_then_place_in_recep": f"Heat a {what} in the microwave and put it {into} the {where}.",
        "pick_cool_then_place_in_recep": f"Cool a {what} in the fridge and put it {into} the {where}.",
        "pick_clean_then_place_in_recep": f"Rinse a {what} under the tap and put it {into} the {where}.",
        "look_at_obj_in_light": f"Hold the {what} and switch on the {words(targets.toggle)} to look at it.",
        "pick_and_place_with_movable_recep": f"Put a {what} into the {words(targets.movable)}, and that {into} the "
        f"{where}.",
    }[task_type]
