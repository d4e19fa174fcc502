"""What the numbers of well-known environments mean: names of actions and of parts of the observation.

Gymnasium's spaces are numbers without names. Environments that name their actions themselves are asked
(`get_action_meanings()`, or an `actions` enumeration); for Gymnasium's own the names stand here, from its
documentation.
"""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Names:
    """Names of the discrete actions in order, of the parts of the observation in order, and the aim in a sentence."""

    actions: tuple[str, ...] = ()
    observation: tuple[str, ...] = ()
    aim: str = ""


KNOWN: dict[str, Names] = {
    "CartPole": Names(
        ("push left", "push right"),
        ("cart position", "cart velocity", "pole angle (rad)", "pole angular velocity"),
        "Balance the pole on the cart: it falls beyond 0.21 rad, and the cart must stay within 2.4 of the middle.",
    ),
    "MountainCar": Names(
        ("accelerate left", "do nothing", "accelerate right"),
        ("position", "velocity"),
        "Bring the car up the hill on the right (position 0.5); it must swing up, its engine is too weak.",
    ),
    "Acrobot": Names(
        ("torque -1", "torque 0", "torque +1"),
        ("cos(angle 1)", "sin(angle 1)", "cos(angle 2)", "sin(angle 2)", "angular velocity 1", "angular velocity 2"),
        "Swing the free end of the two-link chain above the target height.",
    ),
    "LunarLander": Names(
        ("do nothing", "fire left engine", "fire main engine", "fire right engine"),
        ("x", "y", "x velocity", "y velocity", "angle", "angular velocity", "left leg touches", "right leg touches"),
        "Land softly on the pad at (0, 0).",
    ),
    "FrozenLake": Names(
        ("left", "down", "right", "up"),
        ("square",),
        "Cross the ice from the first square to the last without falling into a hole; squares count row by row.",
    ),
    "CliffWalking": Names(
        ("up", "right", "down", "left"),
        ("square",),
        "Walk from square 36 to square 47 of a 4 x 12 grid without stepping on the cliff between them.",
    ),
    "Taxi": Names(
        ("south", "north", "east", "west", "pick up", "drop off"),
        ("state",),
        "Fetch the passenger and bring them to the destination.",
    ),
    "Blackjack": Names(
        ("stick", "hit"), ("your sum", "the dealer's card", "usable ace"), "Come nearer to 21 than the dealer."
    ),
}
"""By the family of ids: `CartPole` for `CartPole-v1`."""


def names_of(env: Any, name: str, actions: int) -> Names:
    """The names for an environment with `actions` discrete actions; numbers where nobody names them.

    Args:
        env: the innermost environment.
        name: its gymnasium id.
    """
    family = re.sub(r"(\d+x\d+|Slippery)?-v\d+$", "", name.rpartition("/")[2])
    known = KNOWN.get(family, Names())
    own = _own_names(env)
    named = next((n for n in (own, known.actions) if len(n) == actions), tuple(f"action {i}" for i in range(actions)))
    return Names(named, known.observation, known.aim)


def _own_names(env: Any) -> tuple[str, ...]:
    meanings = getattr(env, "get_action_meanings", None)
    if callable(meanings):
        return _distinct(str(text).strip().lower() for text in meanings())
    listed = getattr(env, "actions", None)
    if isinstance(listed, type) and issubclass(listed, enum.IntEnum):
        members = sorted(listed, key=int)
        if [int(member) for member in members] == list(range(len(members))):
            return _distinct(member.name.lower().replace("_", " ") for member in members)
    return ()


def _distinct(names: Any) -> tuple[str, ...]:
    """The names, or none of them if two are equal or one is empty: an action must be told by its name."""
    listed = tuple(names)
    return listed if all(listed) and len(set(listed)) == len(listed) else ()
