"""The menu: the few concrete actions that make sense now, as short stable texts.

A small model cannot write `MOVE(120.5m, -48m)` from nothing, but it can learn *what to do next*. In menu mode the
environment offers at most ten choices, each a text such as "pick up order 3" and each standing for exactly one native
call that succeeds now. The texts share their beginnings, so that decoding token by token branches in few places, and no
two of one menu are equal.

Only three offers, those that pay best for their way, can be accepted, and only while fewer than `MAX_ORDERS` are open:
the menu keeps the choice among orders but not the burden of reading all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.calls import Card, View, within_reach
from agentspec.envs.deliverybench.view.cards import IN_BAG, IN_HAND, PREPARING, READY

MAX_CHOICES = 10
MAX_OFFERS = 3
MAX_ORDERS = 3
SHORT_WAIT_S = 60.0
LOW_BATTERY, LOW_ENERGY = 40.0, 40.0
CHARGE_TARGET, REST_TARGET = 80.0, 80.0


@dataclass(frozen=True, slots=True)
class Option:
    """One choice: its text, and the native call it stands for."""

    text: str
    call: str


def best_offers(view: View, count: int = MAX_OFFERS) -> list[Card]:
    """The offers that pay best per metre of the whole errand (to the restaurant and on), best first.

    Offers that can no longer be delivered before the shift ends are left out.
    """
    speed = view["speed"]

    def rate(offer: Card) -> float:
        return float(offer["pay"] + 2.0) / (offer["to_pickup_m"] + offer["distance_m"] + 100.0)

    def feasible(offer: Card) -> bool:
        ready = max(offer["to_pickup_m"] / speed, calls.prep_seconds(offer["items"]))
        return bool(ready + offer["distance_m"] / speed <= view["left_s"])

    offers = [offer for offer in view["offers"] if feasible(offer)]
    return sorted(offers, key=lambda offer: (-rate(offer), offer["id"]))[:count]


def options(view: View) -> list[Option]:
    """The menu for this view, at most `MAX_CHOICES` options in a stable order: work first, then offers, then care."""
    # Food in the hand comes first, and is packed before the courier goes on: no vehicle moves with it (fair rules).
    orders = sorted(view["orders"], key=lambda order: not order["hand"])
    found = [option for order in orders[: MAX_ORDERS + 1] for option in _work(view, order)]
    room = MAX_ORDERS - len(view["orders"])
    if room > 0 and view["room"] != 0:
        found += [accept_option(offer["id"]) for offer in best_offers(view)]
    found += _vehicle(view) + _energy(view)
    if calls.hands_full(view):
        found = [option for option in found if not option.call.startswith("MOVE")]
    found = found[: MAX_CHOICES - 1]
    found.append(Option("wait 1 minute", calls.wait(SHORT_WAIT_S)))
    return list({option.text: option for option in found}.values())


def accept_option(number: int) -> Option:
    """Take an offer."""
    return Option(f"accept order {number}", calls.accept([number]))


def _work(view: View, order: Card) -> list[Option]:
    """The next thing to do for an order."""
    number, status = order["id"], order["status"]
    if status in (PREPARING, READY):
        if not within_reach(view, order["pickup_xy"]):
            return [Option(f"go to pickup of order {number}", calls.move(order["pickup_xy"]))]
        if status == READY:
            return [Option(f"pick up order {number}", calls.pick_up([number]))]
        return [Option(f"wait for order {number}", calls.wait(order["ready_in_s"]))]
    found = []
    if status == IN_HAND:
        found.append(Option(f"bag order {number}", calls.bag(view, [order])))
    method, place = calls.handover(order)
    if within_reach(view, place):
        found.append(Option(f"deliver order {number} {calls.MANNER[method]}", calls.deliver(order)))
    elif status == IN_BAG:
        found.append(Option(f"go to drop-off of order {number}", calls.move(place)))
    return found


def _vehicle(view: View) -> list[Option]:
    """Scooter and battery."""
    mode, charging = view["mode"], view["charging"]
    if mode == "walk":
        near = view["scooter_m"] is not None and view["scooter_m"] <= calls.REACH_M
        if not near:
            xy = view["scooter_xy"]
            return [] if xy is None else [Option("go to scooter", calls.move(xy))]
        ride = Option("ride scooter", 'SWITCH(to="e-scooter")')
        return [Option("wait for charging", 'WAIT("charge_done")'), ride] if charging is not None else [ride]
    station = view["nearest"].get("charging_station")
    if mode not in ("e-scooter", "drag_scooter") or station is None or view["battery"] > LOW_BATTERY:
        return []
    if within_reach(view, station["xy"]):
        return [Option(f"charge to {CHARGE_TARGET:.0f}%", f"CHARGE(target_pct={CHARGE_TARGET:.0f})")]
    return [Option("go to charger", calls.move(station["xy"]))]


def _energy(view: View) -> list[Option]:
    """Drinks and rest."""
    if view["energy"] > LOW_ENERGY:
        return []
    found = []
    if view["inventory"].get("energy_drink"):
        found.append(Option("use energy drink", "USE_ENERGY_DRINK()"))
    area = view["nearest"].get("rest_area")
    if area is not None and within_reach(view, area["xy"]):
        found.append(Option(f"rest to {REST_TARGET:.0f}%", f"REST(target_pct={REST_TARGET:.0f})"))
    elif area is not None:
        found.append(Option("go to rest area", calls.move(area["xy"])))
    return found
