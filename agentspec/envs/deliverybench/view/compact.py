"""The compact texts: the situation in a few lines, for small models and long episodes, with or without a menu."""

from __future__ import annotations

from collections.abc import Sequence

from agentspec.envs.deliverybench.view.calls import Card, View
from agentspec.envs.deliverybench.view.cards import PREPARING
from agentspec.envs.deliverybench.view.choices import Option, best_offers
from agentspec.envs.deliverybench.view.hints import hints
from agentspec.envs.deliverybench.view.wording import (
    HERE,
    SHORT_MODE,
    at,
    away,
    cut,
    deadline,
    exactly,
    in_minutes,
    minutes,
)

COMPACT_OFFERS = 3
LOW, THIRSTY = 40.0, 50.0


def compact_text(view: View, message: str) -> str:
    """The compact native text: situation, own orders, best offers, what can be done here, what the last action did."""
    lines = [_courier(view)]
    lines += [_order(view, order) for order in view["orders"]]
    if any(notice["kind"] == "orders" for notice in view["notices"]):
        lines += [_offer(view, offer) for offer in view["offers"]]
    elif view["room"] != 0:
        lines += [_offer(view, offer) for offer in best_offers(view, COMPACT_OFFERS)]
    lines += _care(view)
    lines += [f"{HERE}: {hint}" for hint in hints(view)]
    if message:
        lines.append(f"last: {message}")
    return "\n".join(lines)


def menu_text(view: View, message: str, choices: Sequence[Option]) -> str:
    """The compact text of menu mode: as few tokens as the choice needs; what a choice takes stands beside it."""
    place = f", at {view['place']}" if view["place"] else ""
    first = (
        f"{minutes(view['left_s'])} min left{place}, {SHORT_MODE.get(view['mode'], view['mode'])}, "
        f"battery {view['battery']:.0f}%, earned ${view['net_earnings']:.1f}"
    )
    if view["energy"] <= THIRSTY:
        first += f", energy {view['energy']:.0f}%"
    if view["charging"] is not None:
        first += f", charging {minutes(view['charging']['left_s'])} min more"
    lines = [first, *(_menu_order(order) for order in view["orders"])]
    if message:
        lines.append(f"last: {cut(message, 90)}")
    lines.append(f"choices: {'; '.join(labelled(choice) for choice in choices)}")
    return "\n".join(lines)


def labelled(choice: Option) -> str:
    """A choice with its note in brackets."""
    return choice.text + (f" ({choice.note})" if choice.note else "")


def _menu_order(order: Card) -> str:
    status = order["status"]
    if status == PREPARING:
        status = f"ready in {minutes(order['ready_in_s'])} min"
    where = "" if order["picked"] else f" at {order['pickup']}"
    return f"order {order['id']}: {status}{where}, {deadline(order['time_left_s'], in_minutes)}, ${order['pay']:.1f}"


def _courier(view: View) -> str:
    place = f"at {view['place']} " if view["place"] else ""
    held = ", ".join(f"{n} {item}" for item, n in view["inventory"].items())
    text = (
        f"{exactly(view['left_s'])} left, {place}{at(view['position'])}, "
        f"{SHORT_MODE.get(view['mode'], view['mode'])}, battery {view['battery']:.0f}% ({view['range_m']:.0f}m), "
        f"energy {view['energy']:.0f}%, ${view['balance']:.2f}, earned ${view['net_earnings']:.2f}"
    )
    if view["mode"] == "walk" and view["scooter_xy"] is not None:
        text += f", scooter at {at(view['scooter_xy'])}"
    if view["car"] is not None and view["car"]["at"] is not None:
        text += f", car at {at(view['car']['at'])}"
    if view["charging"] is not None:
        text += f", charging {exactly(view['charging']['left_s'])} more"
    return text + (f", you have {held}" if held else "")


def _order(view: View, order: Card) -> str:
    status = order["status"]
    if status == PREPARING:
        status = f"ready in {exactly(order['ready_in_s'])}"
    picked = order["picked"]
    if picked:
        xy, metres, goal = order["dropoff_xy"], order["to_dropoff_m"], "drop-off"
    else:
        xy, metres, goal = order["pickup_xy"], order["to_pickup_m"], order["pickup"]
    text = (
        f"order {order['id']}: {status}, {goal} {at(xy)} {away(view, xy, metres)}, "
        f"{deadline(order['time_left_s'])}, ${order['pay']:.2f}"
    )
    if not picked:
        text += f", then to {at(order['dropoff_xy'])} {order['distance_m']}m"
    text += f", {dishes(order)}"
    text += f', note: "{order["note"]}"' if order["note"] else ""
    return text + (f", the customer waits at {at(order['handoff_xy'])}" if order["handoff_xy"] is not None else "")


def dishes(order: Card) -> str:
    """The dishes of an order with the temperature to serve them at, once fetched as `now/serve`: `Burger 58/60C`."""
    parts = []
    for dish in order["dishes"]:
        now = "" if dish["temp"] is None else f"{dish['temp']:.0f}/"
        parts.append(f"{dish['name']} {now}{dish['serve']:.0f}C")
    return ", ".join(parts)


def _offer(view: View, offer: Card) -> str:
    note = f', note: "{offer["note"]}"' if offer["note"] else ""
    return (
        f"offer {offer['id']}: ${offer['pay']:.2f}, {offer['pickup']} {at(offer['pickup_xy'])} "
        f"{away(view, offer['pickup_xy'], offer['to_pickup_m'])}, then to {at(offer['dropoff_xy'])} "
        f"{offer['distance_m']}m, {exactly(offer['limit_s'])}{note}"
    )


def _care(view: View) -> list[str]:
    """Where to charge, rest, shop or rent, when that is about to matter."""
    wanted = []
    if view["battery"] <= LOW and view["mode"] != "car":
        wanted.append("charging_station")
    if view["energy"] <= LOW:
        wanted.append("rest_area")
    if view["energy"] <= LOW or (view["battery"] <= LOW and view["mode"] != "car"):
        wanted.append("store")
    if view["car"] is not None or view["left_s"] >= 900.0:
        wanted.append("car_rental")
    places = [view["nearest"][kind] for kind in wanted if kind in view["nearest"]]
    named = [f"{p['name']} {at(p['xy'])} {away(view, p['xy'], p['m'])}" for p in places]
    return ["near: " + "; ".join(named)] if named else []
