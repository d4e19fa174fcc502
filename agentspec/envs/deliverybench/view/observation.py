"""What the agent reads: a static instruction and a dynamic text, in a full and a compact form.

The instruction holds everything that never changes within a task (role, goal, rules of thumb, prices, the map's
places), so that the prompts of all steps share it as a prefix. The text holds what changes. The full text has the
sections of the benchmark's observation: clock and courier, orders, hand and bag, orders on offer (after VIEW_ORDERS),
surroundings, recent actions, last error, notices. The compact text says the same in a few lines, for small models and
long episodes.

Both are written from the view of `view.describe` alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.envs.deliverybench.city.citymap import City, Point
from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.cards import IN_BAG, IN_HAND, PREPARING, SERVICES
from agentspec.envs.deliverybench.view.menu import best_offers
from agentspec.envs.deliverybench.world.rules import Rules

View = Mapping[str, Any]
Card = Mapping[str, Any]

COMPACT_ORDERS = 4
LOW_ENERGY = 40.0
COMPACT_CHARS = 700
NOTE_CHARS = 60
MODE_WORDS = {"walk": "on foot", "drag_scooter": "dragging the scooter", "car": "in the rented car"}
SHORT_MODE = {"walk": "on foot", "drag_scooter": "dragging scooter", "e-scooter": "scooter"}


# -- the static part -----------------------------------------------------------------------------------------------


def instruction(city: City, rules: Rules, shift_hours: float, compact: bool, menu: bool) -> str:
    """The static instruction of a task: role, goal and rules of thumb; in native full mode also prices and places."""
    goal = (
        "You are a delivery courier. Earn as much money as you can before the shift of "
        f"{_duration(shift_hours * 3600.0)} ends: accept orders, pick the food up when it is ready, put it into your "
        "bag, and hand it over in time and the way the customer's note asks for."
    )
    if menu:
        return (
            f"{goal} Late, cold or shaken food pays less. Take orders whose restaurant and drop-off lie near your way, "
            "and several at once if they fit. Riding drains the battery: charge before it is empty."
        )
    parts = [goal, _rules_of_thumb(rules)]
    if not compact:
        parts += [_prices(rules), _places(city)]
    return "\n\n".join(parts)


def _rules_of_thumb(rules: Rules) -> str:
    speed, energy = rules.speed, rules.energy_per_m
    lines = [
        "Coordinates are metres, x east, y north; write them with the unit m. You act on what is within 5m of you.",
        f"A restaurant starts cooking when you accept; an order pays about ${rules.pay_per_km:.0f} per km, plus up to "
        f"${rules.bonus[5]:.0f} for five stars. From {rules.grace:.0f}s after the deadline on the pay shrinks.",
        "Stars: time first, then food (temperature, smell, damage), then the hand-over the note asks for.",
        "Bag hot and cold food into different compartments, smelly food apart. Pace accel is faster but shakes food.",
        f"Speed m/s: walk {speed['walk'] / 100:g}, e-scooter {speed['e-scooter'] / 100:g}, dragging it "
        f"{speed['drag_scooter'] / 100:g}, car {speed['car'] / 100:g}.",
        f"Energy %/km: walk {energy['walk'] * 1000:g}, e-scooter {energy['e-scooter'] * 1000:g}, car "
        f"{energy['car'] * 1000:g}; at 0 you wake up in hospital. The scooter's battery loses "
        f"{rules.battery_per_m * 1000:g} %/km.",
        f"Charging adds {rules.charge_per_min:g} %/min (${rules.charge_price:.2f} per %), resting "
        f"{rules.rest_per_min:g} %/min.",
    ]
    if not rules.ride_with_food_in_hand:
        lines.append("No vehicle moves while you hold food in your hands: put it into the bag first.")
    return "\n".join(f"- {line}" for line in lines)


def _prices(rules: Rules) -> str:
    goods = ", ".join(f"{item} ${price:.0f}" for item, price in sorted(rules.prices.items()))
    return (
        f"Stores sell: {goods}. A drink gives {rules.drink_gain:.0f} % energy, a battery pack fills the scooter's "
        f"battery. A car costs ${rules.rental_per_min:.2f} per minute from renting to returning, the bus "
        f"${rules.bus_fare:.2f}."
    )


def _places(city: City) -> str:
    lines = ["Places:"]
    for kind in ("restaurant", *SERVICES):
        names = [f"{poi.name} {_at((poi.anchor[0] / 100.0, poi.anchor[1] / 100.0))}" for poi in city.pois_of(kind)]
        if names:
            lines.append("; ".join(names))
    return "\n".join(lines)


# -- the full text ---------------------------------------------------------------------------------------------------


def full_text(view: View, surrounding: str) -> str:
    """The full dynamic text. `surrounding` is the section that `around` writes."""
    sections = [
        _courier(view),
        _listing("Your orders", [_order_line(order) for order in view["orders"]], "none accepted"),
        _hand_and_bag(view),
        _offers(view),
        surrounding,
        _listing("Recent actions", [*view["recent"][:-1], *(f"{a} (newest)" for a in view["recent"][-1:])], "none"),
    ]
    if view["error"]:
        sections.append(f"Last error: {view['error']}")
    news = [notice["text"] for notice in view["notices"] if notice["text"]]
    if news:
        sections.append(_listing("News", news, ""))
    return "\n\n".join(section for section in sections if section)


def surroundings(city: City, point: Point, limit: int = 8) -> dict[str, list[tuple[str, Sequence[float], int]]]:
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
        f"{_clock(view['clock_s'])} on the clock, {_duration(view['left_s'])} left.",
        f"You are {place}{_at(view['position'])}, {mode} ({view['speed']:g} m/s, pace {view['pace']}).",
        f"Energy {view['energy']:.0f} %. Balance ${view['balance']:.2f} (earned {view['net_earnings']:+.2f}).",
        _scooter(view),
    ]
    if view["car"] is not None:
        at = view["car"]["at"]
        where = "" if at is None else f", parked at {_at(at)}"
        parts.append(f"Car rented for {view['car']['minutes']:.0f} min{where}.")
    goods = ", ".join(f"{n} {item}" for item, n in view["inventory"].items())
    parts.append(f"You carry {goods or 'nothing from the store'}.")
    if view["calls_left"] is not None:
        parts.append(f"{view['calls_left']} actions left.")
    return " ".join(parts)


def _scooter(view: View) -> str:
    text = f"Scooter battery {view['battery']:.0f} % ({view['range_m']:.0f}m)"
    if view["scooter_xy"] is not None:
        text += f", parked at {_at(view['scooter_xy'])}"
    if view["charging"] is not None:
        text += f", charging to {view['charging']['target']:.0f} % for {_duration(view['charging']['left_s'])} more"
    return text + "."


def _order_line(order: Card) -> str:
    late = order["time_left_s"] < 0.0
    minutes = math.ceil(abs(order["time_left_s"]) / 60.0)
    time = f"{minutes} min late" if late else f"{minutes} min left"
    status = order["status"]
    if status == PREPARING:
        status = f"ready in {_duration(order['ready_in_s'])}"
    text = (
        f"order {order['id']}: {status}, {time}, pays ${order['pay']:.2f}. Pick-up {order['pickup']} "
        f"{_at(order['pickup_xy'])} {order['pickup_road']} ({order['to_pickup_m']}m); drop-off {order['dropoff']} "
        f"{_at(order['dropoff_xy'])} {order['dropoff_road']} ({order['to_dropoff_m']}m). {', '.join(order['items'])}."
    )
    if order["note"]:
        text += f' Note: "{order["note"]}"'
        if order["handoff_xy"] is not None:
            text += f" The customer waits at {_at(order['handoff_xy'])}."
    return text


def _hand_and_bag(view: View) -> str:
    lines = []
    for order in view["orders"]:
        if order["hand"]:
            items = ", ".join(f"{i} {name}" for i, name in enumerate(order["hand"], start=1))
            lines.append(f"in your hands, order {order['id']}: {items} (put it into the bag)")
    for label, compartment in view["bag"].items():
        if compartment["items"]:
            items = ", ".join(
                f"{label}.{i} {item['name']} {item['temp']:.0f}C"
                for i, item in enumerate(compartment["items"], start=1)
            )
            lines.append(f"{label} ({compartment['air']:.0f}C): {items}")
    return _listing("Hands and bag", lines, "empty")


def _offers(view: View) -> str:
    if not any(notice["kind"] == "orders" for notice in view["notices"]):
        return f"{len(view['offers'])} orders are on offer; VIEW_ORDERS() lists them."
    lines = []
    for offer in view["offers"]:
        foods = ", ".join(f"{name} {calls.FOODS[name].serving:g}C" for name in offer["items"])
        note = f' Note: "{offer["note"]}"' if offer["note"] else ""
        lines.append(
            f"order {offer['id']}: ${offer['pay']:.2f}, {offer['distance_m']}m, {_minutes(offer['limit_s'])} min. "
            f"From {offer['pickup']} {_at(offer['pickup_xy'])} {offer['pickup_road']} "
            f"({offer['to_pickup_m']}m from you) to {_at(offer['dropoff_xy'])} {offer['dropoff_road']}. {foods}.{note}"
        )
    return _listing("Orders on offer", lines, "none")


def _around(view: View, extra: Mapping[str, Any]) -> str:
    lines = []
    nearest = view["nearest"]
    if nearest:
        lines.append("nearest: " + "; ".join(f"{p['name']} {_at(p['xy'])} {p['m']}m" for p in nearest.values()))
    for title, key in (("ways from here", "ways"), ("junctions", "junctions")):
        points = [f"{_at(xy)} {d}m{f' on {road}' if road else ''}" for road, xy, d in extra.get(key, ())]
        if points:
            lines.append(f"{title}: " + "; ".join(points))
    return _listing("Around you", lines, "nothing")


# -- the compact text --------------------------------------------------------------------------------------------------


def compact_text(view: View, message: str, choices: Sequence[str]) -> str:
    """The compact dynamic text: situation, own orders, best offers (or the menu), and what the last action did.

    At most about `COMPACT_CHARS` characters; with `choices` the listing of the menu is part of it.
    """
    if choices:
        return _menu_text(view, message, choices)
    lines = [_compact_courier(view)]
    lines += [_compact_order(order, True) for order in view["orders"][:COMPACT_ORDERS]]
    hidden = len(view["orders"]) - COMPACT_ORDERS
    if hidden > 0:
        lines.append(f"and {hidden} more orders")
    lines += [_compact_offer(offer) for offer in best_offers(view)]
    lines += _compact_care(view)
    if message:
        lines.append(f"last: {_cut(message, 90)}")
    return "\n".join(lines)


def _menu_text(view: View, message: str, choices: Sequence[str]) -> str:
    """The compact text of menu mode: as few tokens as the choice needs; an offer's terms stand beside its choice."""
    place = f", at {view['place']}" if view["place"] else ""
    lines = [
        f"{_minutes(view['left_s'])} min left{place}, {SHORT_MODE.get(view['mode'], view['mode'])}, "
        f"battery {view['battery']:.0f}%, earned ${view['net_earnings']:.1f}"
    ]
    if view["energy"] <= LOW_ENERGY:
        lines[0] += f", energy {view['energy']:.0f}%"
    if view["charging"] is not None:
        lines[0] += f", charging {_minutes(view['charging']['left_s'])} min more"
    lines += [_compact_order(order, False) for order in view["orders"][:COMPACT_ORDERS]]
    if message:
        lines.append(f"last: {_cut(message, 90)}")
    terms = {f"accept order {o['id']}": _terms(o) for o in view["offers"]}
    lines.append("choices: " + "; ".join(choice + terms.get(choice, "") for choice in choices))
    return "\n".join(lines)


def _terms(offer: Card) -> str:
    """Pay, way to the restaurant plus way to the customer, and the time allowed."""
    way = f"{offer['to_pickup_m']:.0f}m + {offer['distance_m']:.0f}m"
    return f" (${offer['pay']:.1f}, {way}, {_minutes(offer['limit_s'])} min)"


def _compact_courier(view: View) -> str:
    place = f"at {view['place']}, " if view["place"] else ""
    where = "" if place else f"{_at(view['position'])}, "
    text = (
        f"{_minutes(view['left_s'])} min left, {place}{where}{SHORT_MODE.get(view['mode'], view['mode'])}, "
        f"battery {view['battery']:.0f}%, energy {view['energy']:.0f}%, earned ${view['net_earnings']:.2f}"
    )
    if view["charging"] is not None:
        text += f", charging {_minutes(view['charging']['left_s'])} min more"
    return text


def _compact_order(order: Card, native: bool) -> str:
    status, left = order["status"], _minutes(order["time_left_s"])
    if status == PREPARING:
        status = f"ready in {_minutes(order['ready_in_s'])} min"
    picked = order["status"] in (IN_HAND, IN_BAG)
    goal = "drop-off" if picked else "pickup"
    xy, way = (
        (calls.handover(order)[1], order["to_dropoff_m"]) if picked else (order["pickup_xy"], order["to_pickup_m"])
    )
    where = f" {_at(xy)}" if native else ""
    pay = f"${order['pay']:.2f}" if native else f"${order['pay']:.1f}"
    text = f"order {order['id']}: {status}, {goal}{where} {way}m, {left} min, {pay}"
    if native and order["status"] == IN_HAND:
        text += f", in hand: {', '.join(order['hand'])}"
    if native and picked and order["note"]:
        text += f', note: "{_cut(order["note"], NOTE_CHARS)}"'
    return text


def _compact_offer(offer: Card) -> str:
    return (
        f"offer {offer['id']}: ${offer['pay']:.2f}, {offer['pickup']} at {_at(offer['pickup_xy'])} "
        f"{offer['to_pickup_m']}m, then {offer['distance_m']}m, {_minutes(offer['limit_s'])} min"
    )


def _compact_care(view: View) -> list[str]:
    """Where to charge, rest or shop, only when that is about to matter."""
    wanted = []
    if view["battery"] <= 40.0 and view["mode"] != "car":
        wanted.append("charging_station")
    if view["energy"] <= 40.0:
        wanted += ["rest_area", "store"]
    places = [view["nearest"][kind] for kind in wanted if kind in view["nearest"]]
    return ["near: " + "; ".join(f"{p['name']} {_at(p['xy'])} {p['m']}m" for p in places)] if places else []


# -- wording -----------------------------------------------------------------------------------------------------------


def _listing(title: str, lines: Sequence[str], empty: str) -> str:
    return f"{title}: {empty}." if not lines else f"{title}:\n" + "\n".join(f"- {line}" for line in lines)


def _at(xy: Sequence[float]) -> str:
    # Adding zero turns -0.0 into 0.0.
    return f"({round(xy[0], 1) + 0.0:.1f}m, {round(xy[1], 1) + 0.0:.1f}m)"


def _clock(seconds: float) -> str:
    whole = int(seconds)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def _minutes(seconds: float) -> int:
    return math.ceil(seconds / 60.0 - 1e-9)


def _duration(seconds: float) -> str:
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    hours, minutes = divmod(round(whole / 60.0), 60)
    return f"{hours} h {minutes} min" if hours and minutes else (f"{hours} h" if hours else f"{minutes} min")


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."


__all__ = ["around", "compact_text", "full_text", "instruction", "surroundings"]
