"""Native action calls for common intentions: what to write, where to stand, how to pack, how to hand over.

Everything here reads the view of `view.describe` only. Menu and couriers share it, so that an option of the menu and
the scripted expert write the same call for the same purpose.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.envs.deliverybench.world.food import MENU, Food
from agentspec.envs.deliverybench.world.notes import CALL, HAND, KNOCK, LEAVE, NOTES
from agentspec.envs.deliverybench.world.packing import HOME

View = Mapping[str, Any]
Card = Mapping[str, Any]

_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")

REACH_M = 5.0
"""How near one must stand to pick up, deliver, charge, shop or rest (metres)."""

FOODS: Mapping[str, Food] = {food.name: food for food in MENU}
METHODS_OF: Mapping[str, tuple[str, ...]] = dict(NOTES)
MANNER: Mapping[str, str] = {LEAVE: "at the door", KNOCK: "by knocking", CALL: "by calling", HAND: "by hand"}

# Weights of a dish's misfit in a compartment: neighbours of another smell or temperature, and cold walls.
_SMELL_PENALTY = 25.0
_DEGREE_PENALTY = 1.0
_EMPTY_PENALTY = 8.0


def distance(a: Sequence[float], b: Sequence[float]) -> float:
    """Straight line between two points (metres)."""
    return math.hypot(a[0] - b[0], a[1] - b[1])


def within_reach(view: View, xy: Sequence[float]) -> bool:
    """Whether the courier stands within reach of a point, with 5 cm to spare for rounding."""
    return distance(view["position"], xy) <= REACH_M - 0.05


def hands_full(view: View) -> bool:
    """Whether picked-up food is not in the bag yet."""
    return any(order["hand"] for order in view["orders"])


def fragile_carried(view: View) -> bool:
    """Whether dishes are carried that a hasty move damages."""
    carried = (order for order in view["orders"] if order["picked"])
    return any(FOODS[name].fragile for order in carried for name in order["items"])


def numbers_in(call: str) -> list[float]:
    """The numbers in a call, in order."""
    return [float(number) for number in _NUMBER.findall(call)]


def move(xy: Sequence[float], pace: str = "normal") -> str:
    """A MOVE to a point in metres."""
    tail = "" if pace == "normal" else f', pace="{pace}"'
    return f"MOVE({xy[0]:.2f}m, {xy[1]:.2f}m{tail})"


def accept(ids: Sequence[int]) -> str:
    """Accept one or several offers."""
    return f"ACCEPT_ORDER([{', '.join(str(n) for n in ids)}])"


def pick_up(ids: Sequence[int]) -> str:
    """Pick up one or several orders."""
    return f"PICKUP(orders=[{', '.join(str(n) for n in ids)}])"


def wait(seconds: float) -> str:
    """Wait, rounded up to a tenth of a second."""
    return f"WAIT({math.ceil(seconds * 10.0 - 1e-6) / 10.0:g})"


def prep_seconds(items: Sequence[str]) -> float:
    """Seconds from acceptance until the food is ready, from the names of the dishes."""
    return float(max((FOODS[name].prep for name in items), default=0))


def handover(order: Card) -> tuple[str, Sequence[float]]:
    """The hand-over method that fits the customer's note, and where to stand for it (metres).

    The note decides; of several welcome methods one at the door is chosen, because the way is known. A customer who
    only takes the food by hand is met where they wait, if that place is told.
    """
    methods = METHODS_OF.get(order["note"], ())
    for method in (LEAVE, KNOCK, CALL):
        if not methods or method in methods:
            return method, order["dropoff_xy"]
    if order.get("handoff_xy") is not None:
        return HAND, order["handoff_xy"]
    return LEAVE, order["dropoff_xy"]


def deliver(order: Card) -> str:
    """Hand the order over as its note wishes."""
    return f'DROP_OFF(oid={order["id"]}, method="{handover(order)[0]}")'


def bag(view: View, orders: Sequence[Card]) -> str:
    """Put all food in the hand into the bag: like to like in temperature, and smelly food apart."""
    contents = {
        label: [FOODS[item["name"]] for item in compartment["items"] if item["name"] in FOODS]
        for label, compartment in view["bag"].items()
    }
    blocks = []
    for order in orders:
        placed: dict[str, list[str]] = {}
        for number, name in enumerate(order["hand"], start=1):
            food = FOODS[name]
            label = min(contents, key=lambda label: _misfit(label, contents[label], food))
            contents[label].append(food)
            placed.setdefault(label, []).append(str(number))
        clauses = "; ".join(f"{','.join(numbers)} -> {label}" for label, numbers in placed.items())
        blocks.append(f"order {order['id']}: {clauses}")
    return f'PLACE_FOOD_IN_BAG(bag_cmd="{" ".join(blocks)}")'


def _misfit(label: str, contents: Sequence[Food], food: Food) -> float:
    """How badly a dish fits into a compartment: degrees to its neighbours, smell, and cold walls of an empty one."""
    if not contents:
        return _EMPTY_PENALTY + (0.0 if HOME.get(food.category, "D") == label else 1.0)
    degrees = max(abs(food.serving - other.serving) for other in contents)
    smell = any(food.smells != other.smells for other in contents)
    return _DEGREE_PENALTY * degrees + (_SMELL_PENALTY if smell else 0.0)
