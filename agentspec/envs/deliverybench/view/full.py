"""The full text: everything that changes, in the sections of the benchmark's observation.

Clock and courier, own orders, hands and bag, orders on offer (after VIEW_ORDERS), what can be done here, surroundings,
what the last action did, news, plan. What never changes stands in the instruction, what came
before the last action in the conversation or in memory. Everything is written from the
view of `cards.describe` alone; only the streets around come from the city.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from agentspec.envs.deliverybench.city.citymap import City, Point
from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.calls import Card, View
from agentspec.envs.deliverybench.view.cards import PREPARING
from agentspec.envs.deliverybench.view.choices import Option
from agentspec.envs.deliverybench.view.compact import labelled
from agentspec.envs.deliverybench.view.hints import hints
from agentspec.envs.deliverybench.view.wording import (
    MODE_WORDS,
    at,
    away,
    clock,
    deadline,
    exactly,
    listing,
)


def full_text(view: View, surrounding: str, plan: str = "", menu: Sequence[Option] = (), *, message: str = "") -> str:
    """The full dynamic text.

    `surrounding` is the section that `around` writes; `plan` what the agent last planned; `message` what the last
    action did. With a `menu` its choices take the place of the hints, and the offers are always listed.
    """
    possible = [] if menu else hints(view)
    sections = [
        _courier(view),
        listing("Your orders", [_order_line(view, order) for order in view["orders"]], "none accepted"),
        _hand_and_bag(view),
        _offers(view, bool(menu)),
        listing("Here you can", possible, "") if possible else "",
        surrounding,
        f"Last action: {message}" if message else "",
    ]
    if view["error"] and view["error"] not in message:
        sections.append(f"Last error: {view['error']}")
    if plan:
        sections.append(f"Your plan: {plan}")
    told = ("bagging", "settled")  # by a hint, and by what the last action did
    news = [notice["text"] for notice in view["notices"] if notice["text"] and notice["kind"] not in told]
    if news:
        sections.append(listing("News", news, ""))
    if menu:
        # The terms of an offer stand on the board above.
        shown = [replace(option, note="") if option.kind == "accept" else option for option in menu]
        sections.append(listing("Choices", [labelled(option) for option in shown], ""))
    return "\n\n".join(section for section in sections if section)


def surroundings(city: City, point: Point, limit: int = 5) -> dict[str, list[tuple[str, Sequence[float], int]]]:
    """Street points next to `point` (cm): `ways` (any) and `junctions`, each (road, point in metres, metres), nearest
    first, at most `limit` of each."""
    field = city.distances_from(point)
    graph = city.walk
    found: dict[str, list[tuple[str, Sequence[float], int]]] = {}
    for title, kind in (("ways", "normal"), ("junctions", "intersection")):
        points: list[tuple[str, Sequence[float], int]] = []
        for d, i in field.nearest_nodes(kind, limit):
            px, py = graph.points[i]
            points.append((graph.names[i], (px / 100.0, py / 100.0), round((d + field.gap) / 100.0)))
        found[title] = points
    return found


def around(city: City, point: Point, view: View) -> str:
    """The section about the surroundings of the courier, who stands at `point` (cm): written once for each place."""
    memo = city.distances_from(point).memo
    text: str | None = memo.get("around")
    if text is None:
        text = memo["around"] = _around(view, surroundings(city, point))
    return text


def _courier(view: View) -> str:
    place = f"at {view['place']} " if view["place"] else ""
    mode = MODE_WORDS.get(view["mode"], f"by {view['mode']}")
    parts = [
        f"{clock(view['clock_s'])} on the clock, {exactly(view['left_s'])} left.",
        f"You are {place}{at(view['position'])}, {mode} ({view['speed']:g} m/s, pace {view['pace']}).",
        f"Energy {view['energy']:.0f} %. Balance ${view['balance']:.2f} (earned {view['net_earnings']:+.2f}).",
        _scooter(view),
    ]
    if view["car"] is not None:
        parked = view["car"]["at"]
        where = "" if parked is None else f", parked at {at(parked)}"
        parts.append(f"Car rented for {view['car']['minutes']:.0f} min{where}.")
    goods = ", ".join(f"{n} {item}" for item, n in view["inventory"].items())
    parts.append(f"You carry {goods or 'nothing from the store'}.")
    if view["calls_left"] is not None:
        parts.append(f"{view['calls_left']} actions left.")
    return " ".join(parts)


def _scooter(view: View) -> str:
    text = f"Scooter battery {view['battery']:.0f} % ({view['range_m']:.0f}m)"
    if view["scooter_xy"] is not None:
        text += f", parked at {at(view['scooter_xy'])}"
    if view["charging"] is not None:
        text += f", charging to {view['charging']['target']:.0f} % for {exactly(view['charging']['left_s'])} more"
    return text + "."


def _order_line(view: View, order: Card) -> str:
    status = order["status"]
    if status == PREPARING:
        status = f"ready in {exactly(order['ready_in_s'])}"
    text = f"order {order['id']}: {status}, {deadline(order['time_left_s'])}, pays ${order['pay']:.2f}."
    if not order["picked"]:
        way = away(view, order["pickup_xy"], order["to_pickup_m"])
        text += f" Pick-up {order['pickup']} {at(order['pickup_xy'])} {order['pickup_road']} ({way}), from there"
        text += f" {order['distance_m']}m to the"
    way = away(view, order["dropoff_xy"], order["to_dropoff_m"])
    text += (
        f" {'drop-off' if not order['picked'] else 'Drop-off'} {order['dropoff']} {at(order['dropoff_xy'])} "
        f"{order['dropoff_road']} ({way}). {', '.join(_served(order))}."
    )
    if order["note"]:
        text += f' Note: "{order["note"]}"'
        if order["handoff_xy"] is not None:
            text += f" To take it in person the customer waits at {at(order['handoff_xy'])}."
    return text


def _served(order: Card) -> list[str]:
    """Dishes with the temperature to serve them at."""
    return [f"{dish['name']} {dish['serve']:.0f}C" for dish in order["dishes"]]


def _hand_and_bag(view: View) -> str:
    lines = []
    for order in view["orders"]:
        if order["hand"]:
            warm = {dish["name"]: f" {dish['temp']:.0f}C" for dish in order["dishes"] if dish["temp"] is not None}
            items = ", ".join(f"{i} {name}{warm.get(name, '')}" for i, name in enumerate(order["hand"], start=1))
            lines.append(f"in your hands, order {order['id']}: {items}")
    for label, compartment in view["bag"].items():
        if compartment["items"]:
            items = ", ".join(
                f"{label}.{i} {item['name']} {item['temp']:.0f}C{_owner(item)}"
                for i, item in enumerate(compartment["items"], start=1)
            )
            lines.append(f"{label} ({compartment['air']:.0f}C): {items}")
    return listing("Hands and bag", lines, "empty")


def _owner(item: Card) -> str:
    return "" if item["order"] is None else f" (order {item['order']})"


def _offers(view: View, always: bool) -> str:
    if not always and not any(notice["kind"] == "orders" for notice in view["notices"]):
        return f"{len(view['offers'])} orders are on offer; VIEW_ORDERS() lists them."
    lines = []
    for offer in view["offers"]:
        foods = ", ".join(f"{name} {calls.FOODS[name].serving:g}C" for name in offer["items"])
        note = f' Note: "{offer["note"]}"' if offer["note"] else ""
        lines.append(
            f"order {offer['id']}: ${offer['pay']:.2f}, {offer['distance_m']}m, {exactly(offer['limit_s'])}. "
            f"From {offer['pickup']} {at(offer['pickup_xy'])} {offer['pickup_road']} "
            f"({away(view, offer['pickup_xy'], offer['to_pickup_m'])}) to {at(offer['dropoff_xy'])} "
            f"{offer['dropoff_road']}. {foods}.{note}"
        )
    return listing("Orders on offer", lines, "none")


def _around(view: View, extra: Mapping[str, Any]) -> str:
    lines = []
    nearest = view["nearest"]
    if nearest:
        lines.append(
            "nearest: "
            + "; ".join(f"{p['name']} {at(p['xy'])} {away(view, p['xy'], p['m'])}" for p in nearest.values())
        )
    for title, key in (("ways from here", "ways"), ("junctions", "junctions")):
        points = [f"{at(xy)} {d}m{f' on {road}' if road else ''}" for road, xy, d in extra.get(key, ())]
        if points:
            lines.append(f"{title}: " + "; ".join(points))
    return listing("Around you", lines, "nothing")


__all__ = ["around", "full_text", "surroundings"]
