"""What a courier could do next, as single choices: the material of the menu.

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
LEVELS = (80.0, 100.0, 60.0, 40.0)
DRINK, PACK, ICE, HEAT = "energy_drink", "escooter_battery_pack", "ice_pack", "heat_pack"
GOODS: Mapping[str, str] = {DRINK: "energy drink", PACK: "battery pack", ICE: "ice pack", HEAT: "heat pack"}
PARTNERS = 6
"""How many of the best offers are tried as the second of a pair."""

SHORT_WAIT_S, LONG_WAIT_S = 60.0, 300.0


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


def work_here(view: View) -> list[Option]:
    """What can be done for the open orders without moving: deliver, bag, pick up, wait for the kitchen."""
    found = []
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
        found.append(Option(text, calls.wait(max(1.0, seconds)), "wait", note, 0.0, seconds))
    return found


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


# -- vehicles ----------------------------------------------------------------------------------------------------------


def mounts(view: View) -> list[Option]:
    """On foot: get back onto a vehicle, or to it."""
    if view["mode"] != "walk":
        return []
    found = []
    car = view["car"]
    if car is not None and car["at"] is not None:
        if within_reach(view, car["at"]):
            found.append(Option("drive car", 'SWITCH(to="car")', "vehicle"))
        else:
            found.append(_errand(view, "car", car["at"], calls.distance(view["position"], car["at"])))
    if view["scooter_xy"] is not None:
        if within_reach(view, view["scooter_xy"]):
            if view["charging"] is not None:
                left = view["charging"]["left_s"]
                found.append(
                    Option("wait for charging", 'WAIT("charge_done")', "wait", duration(left), 0.0, left),
                )
            found.append(Option("ride scooter", 'SWITCH(to="e-scooter")', "vehicle"))
        elif car is None:
            found.append(_errand(view, "scooter", view["scooter_xy"], view["scooter_m"]))
    return found


def car(view: View) -> list[Option]:
    """Rent a car, or give it back; the way to the rental."""
    rental = view["nearest"].get("car_rental")
    if rental is None:
        return []
    if not within_reach(view, rental["xy"]):
        return [_errand(view, "car rental", rental["xy"], rental["m"])]
    if view["car"] is None:
        return [Option("rent car", "RENT_CAR()", "car")]
    return [Option("return car", "RETURN_CAR()", "car")] if _at_hand(view, view["car"]["at"]) else []


def charging(view: View) -> list[Option]:
    """Charge to a level, or the way to the nearest charger."""
    station = view["nearest"].get("charging_station")
    if station is None or view["charging"] is not None or not _at_hand(view, view["scooter_xy"]):
        return []
    if not within_reach(view, station["xy"]):
        return [_errand(view, "charger", station["xy"], station["m"])]
    found = []
    for level in LEVELS:
        missing = level - view["battery"]
        if missing > 1.0:
            note = f"{duration(60.0 * missing / view['charge_per_min'])}, ${missing * view['charge_price']:.1f}"
            seconds = 60.0 * missing / view["charge_per_min"]
            cost = -missing * view["charge_price"]
            text = f"charge to {level:.0f}%"
            found.append(Option(text, f"CHARGE(target_pct={level:.0f})", "charge", note, 0.0, seconds, cost))
    return found


def on_foot(view: View) -> list[Option]:
    """Leave the vehicle here."""
    return [] if view["mode"] == "walk" else [Option("leave vehicle, go on foot", 'SWITCH(to="walk")', "vehicle")]


def bus(view: View) -> list[Option]:
    """Ride, wait for the bus, or go to the nearest stop."""
    line = view["bus"]
    if line is None:
        return []
    if not line["here"]:
        stop = view["nearest"].get("bus_station")
        return [] if stop is None else [_errand(view, "bus stop", stop["xy"], stop["m"])]
    if line["stopped"] and line["stop"] == line["here"]:
        return [
            Option(f"take bus to {stop}", f'BOARD_BUS(bus_id="bus_1", target_stop_id="{stop}")', "bus")
            for stop in dict.fromkeys(line["stops"])
            if stop != line["here"] and view["balance"] >= 1.0
        ]
    seconds = line["here_s"]
    return [Option("wait for bus", calls.wait(max(1.0, seconds)), "wait", duration(seconds), 0.0, seconds)]


# -- energy and shopping -----------------------------------------------------------------------------------------------


def resting(view: View) -> list[Option]:
    """Rest to a level, or the way to the nearest rest area."""
    area = view["nearest"].get("rest_area")
    if area is None or view["energy"] >= 99.0:
        return []
    if not within_reach(view, area["xy"]):
        return [_errand(view, "rest area", area["xy"], area["m"])]
    return [
        Option(
            f"rest to {level:.0f}%", f"REST(target_pct={level:.0f})", "rest",
            duration(60.0 * (level - view["energy"]) / view["rest_per_min"]),
            0.0, 60.0 * (level - view["energy"]) / view["rest_per_min"],
        )
        for level in LEVELS
        if level - view["energy"] > 1.0
    ]  # fmt: skip


def shopping(view: View) -> list[Option]:
    """Buy one of each kind, as far as the money goes, or the way to the nearest store."""
    store = view["nearest"].get("store")
    if store is None:
        return []
    if not within_reach(view, store["xy"]):
        return [_errand(view, "store", store["xy"], store["m"])]
    return [
        Option(f"buy {name}", f'BUY(item_id="{item}", qty=1)', "buy", f"${price:.0f}", dollars=-price)
        for item, name in GOODS.items()
        if (price := view["prices"].get(item)) is not None and view["balance"] >= price
    ]


def using(view: View) -> list[Option]:
    """Use what was bought: drinks, battery packs, ice for the coldest compartment and heat for the hottest."""
    held, found = view["inventory"], []
    if held.get(DRINK) and view["energy"] < 100.0:
        found.append(Option("use energy drink", "USE_ENERGY_DRINK()", "use"))
    if held.get(PACK) and _at_hand(view, view["scooter_xy"]):
        found.append(Option("use battery pack", "USE_BATTERY_PACK()", "use"))
    food = {label: [i["temp"] for i in c["items"] if i["order"] is not None] for label, c in view["bag"].items()}
    warmth = {label: temps for label, temps in food.items() if temps}
    if held.get(ICE):
        label = min(warmth, key=lambda label: min(warmth[label]), default="B")
        found.append(Option(f"put ice pack into {label}", f'USE_ICE_PACK(comp="{label}")', "use"))
    if held.get(HEAT):
        label = max(warmth, key=lambda label: max(warmth[label]), default="A")
        found.append(Option(f"put heat pack into {label}", f'USE_HEAT_PACK(comp="{label}")', "use"))
    return found


def waits(view: View) -> list[Option]:
    """Let time pass."""
    left = max(1.0, view["left_s"])
    return [
        Option("wait 1 minute", calls.wait(SHORT_WAIT_S), "wait", "", 0.0, SHORT_WAIT_S),
        Option("wait 5 minutes", calls.wait(LONG_WAIT_S), "wait", "", 0.0, LONG_WAIT_S),
        Option("wait for the end of the shift", calls.wait(left), "wait", duration(left), 0.0, left),
    ]


def _errand(view: View, name: str, xy: Sequence[float], metres: float) -> Option:
    seconds = metres / view["speed"]
    return Option(f"go to {name}", calls.move(xy), "errand", f"{metres:.0f}m", metres, seconds)


def _at_hand(view: View, parked: Sequence[float] | None) -> bool:
    """Whether a vehicle is in use (not parked) or parked within reach."""
    return parked is None or within_reach(view, parked)
