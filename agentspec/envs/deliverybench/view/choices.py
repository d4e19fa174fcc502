"""What a courier could do next for the orders, as single choices: half of the material of the menu, beside `upkeep`.

Each function lists the choices of one topic, best first. A choice is a short text that stays the same from step to
step, the one native call it stands for, and what is worth knowing about it (way, time, money): for the text beside the
choice, and as numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import repeat

from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.calls import Card, View, within_reach
from agentspec.envs.deliverybench.view.cards import IN_BAG, IN_HAND, PREPARING, READY
from agentspec.envs.deliverybench.view.wording import duration, minutes

KINDS = (
    "deliver",
    "bag",
    "pick up",
    "wait",
    "go",
    "hurry",
    "accept",
    "vehicle",
    "car",
    "charge",
    "rest",
    "buy",
    "use",
    "bus",
    "errand",
    "more",
)
MAX_ORDERS = 8
DRINK, PACK, ICE, HEAT = "energy_drink", "escooter_battery_pack", "ice_pack", "heat_pack"
GOODS: Mapping[str, str] = {DRINK: "energy drink", PACK: "battery pack", ICE: "ice pack", HEAT: "heat pack"}
PARTNERS = 6
"""How many of the best offers are tried as the second of a pair."""


@dataclass(frozen=True, slots=True)
class Option:
    """One choice.

    Attributes:
        text: what to answer.
        call: the native call it stands for; "" turns the page.
        kind: one of `KINDS`.
        note: what is worth knowing now, shown in brackets beside the text.
        metres, seconds, dollars: the way, the time it takes or leaves, what it brings (negative: costs).
    """

    text: str
    call: str
    kind: str
    note: str = ""
    metres: float = 0.0
    seconds: float = 0.0
    dollars: float = 0.0


# -- orders ------------------------------------------------------------------------------------------------------------


def work_here(view: View) -> tuple[list[Option], list[Option]]:
    """What can be done for the open orders without moving: deliver, bag, pick up; and waits for the kitchen here."""
    found, patience = [], []
    for order in view["orders"]:
        method, place = calls.handover(order)
        if order["status"] in (IN_BAG, IN_HAND) and within_reach(view, place):
            text = f"deliver order {order['id']} {calls.MANNER[method]}"
            found.append(Option(text, calls.deliver(order), "deliver", "", 0.0, order["time_left_s"], order["pay"]))
    hand = [order for order in view["orders"] if order["hand"]]
    if hand:
        found.append(Option(f"bag {_orders(hand)}", calls.bag(view, hand), "bag"))
    here = [o for o in view["orders"] if o["status"] in (READY, PREPARING) and within_reach(view, o["pickup_xy"])]
    ready = [order for order in here if order["status"] == READY]
    if ready:
        found.append(Option(f"pick up {_orders(ready)}", calls.pick_up([order["id"] for order in ready]), "pick up"))
    for order in sorted((o for o in here if o["status"] == PREPARING), key=lambda order: order["ready_in_s"]):
        seconds = order["ready_in_s"]
        text, note = f"wait for order {order['id']}", duration(seconds)
        patience.append(Option(text, calls.wait(max(1.0, seconds)), "wait", note, 0.0, seconds))
    return found, patience


def ways(view: View) -> list[tuple[Option, Option]]:
    """The ways to restaurants and customers, each in two paces, the advisable one first; soonest useful first."""
    stops: dict[str, tuple[float, Sequence[float], float]] = {}
    for order in view["orders"]:
        if order["status"] in (PREPARING, READY):
            goal, text, metres = order["pickup_xy"], order["pickup"], order["to_pickup_m"]
            soon = max(metres / view["speed"], order["ready_in_s"])
        else:
            goal, text, metres = calls.handover(order)[1], f"drop-off of order {order['id']}", order["to_dropoff_m"]
            soon = metres / view["speed"]
        if not within_reach(view, goal) and soon < stops.get(text, (float("inf"),))[0]:
            stops[text] = (soon, goal, metres)
    gentle = calls.fragile_carried(view)
    found = []
    for text, (_, goal, metres) in sorted(stops.items(), key=lambda stop: stop[1][0]):
        slow = gentle or (view["mode"] == "e-scooter" and view["range_m"] < 1.25 * metres + 50.0)
        seconds = metres / view["speed"]
        pair = (
            Option(f"hurry to {text}", calls.move(goal, "accel"), "hurry", f"{metres}m", metres, seconds / 1.25),
            Option(f"go to {text}", calls.move(goal), "go", f"{metres}m", metres, seconds),
        )
        found.append((pair[1], pair[0]) if slow else pair)
    return found


def best_offers(view: View, count: int) -> list[Card]:
    """The offers that pay best for the way they add, best first.

    The way added is measured in straight lines from the courier and all open stops. Offers that can no longer be
    delivered before the shift ends are left out.
    """
    speed = view["speed"]
    anchors = [view["position"], *open_stops(view)]

    def feasible(offer: Card) -> bool:
        ready = max(offer["to_pickup_m"] / speed, calls.prep_seconds(offer["items"]))
        return bool(ready + offer["distance_m"] / speed <= view["left_s"])

    offers = [offer for offer in view["offers"] if feasible(offer)]
    return sorted(offers, key=lambda offer: (-rate(offer, anchors), offer["id"]))[:count]


def open_stops(view: View) -> list[Sequence[float]]:
    """Where the open orders still lead: restaurants of those not fetched, customers of all."""
    stops = [order["pickup_xy"] for order in view["orders"] if order["status"] in (PREPARING, READY)]
    return stops + [order["dropoff_xy"] for order in view["orders"]]


def rate(offer: Card, anchors: Sequence[Sequence[float]]) -> float:
    """Dollars per metre that an offer adds to a round through `anchors` (the courier first)."""
    pickup, dropoff = offer["pickup_xy"], offer["dropoff_xy"]
    to_pickup = min(map(math.dist, anchors, repeat(pickup)))
    to_dropoff = min(map(math.dist, (pickup, *anchors[1:]), repeat(dropoff)))
    return float((offer["pay"] + 2.0) / (to_pickup + to_dropoff + 100.0))


def offers(view: View) -> list[Option]:
    """Offers to accept, best first; second the pair of the best one with what suits it most."""
    room = MAX_ORDERS - len(view["orders"])
    if view["room"] is not None:
        room = min(room, view["room"])
    if room <= 0:
        return []
    best = best_offers(view, len(view["offers"]))
    found = [
        Option(
            accept_text(offer["id"]), calls.accept([offer["id"]]), "accept", terms(offer),
            offer["to_pickup_m"] + offer["distance_m"], offer["limit_s"], offer["pay"],
        )
        for offer in best
    ]  # fmt: skip
    if room > 1 and len(best) > 1:
        first = best[0]
        anchors = [view["position"], *open_stops(view), first["pickup_xy"], first["dropoff_xy"]]
        second = max(best[1:PARTNERS], key=lambda offer: (rate(offer, anchors), -offer["id"]))
        ids, pay = [first["id"], second["id"]], first["pay"] + second["pay"]
        text = f"accept orders {ids[0]}, {ids[1]}"
        found.insert(1, Option(text, calls.accept(ids), "accept", f"${pay:.1f}", dollars=pay))
    return found


def accept_text(number: int) -> str:
    """The text of taking one offer."""
    return f"accept order {number}"


def terms(offer: Card) -> str:
    """Pay, way to the restaurant plus way to the customer, and the time allowed."""
    return f"${offer['pay']:.1f}, {offer['to_pickup_m']}m + {offer['distance_m']}m, {minutes(offer['limit_s'])} min"


def _orders(orders: Sequence[Card]) -> str:
    numbers = ", ".join(str(order["id"]) for order in orders)
    return f"order {numbers}" if len(orders) == 1 else f"orders {numbers}"
