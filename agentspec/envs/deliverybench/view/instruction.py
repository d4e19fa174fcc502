"""The static instruction of a task: role, goal, rules, and for native play also prices and places.

It holds everything that never changes within a task, so that the prompts of all steps share it as a prefix. How to
answer is not in it: that is the business of whoever asks.
"""

from __future__ import annotations

import math

from agentspec.envs.deliverybench.city.citymap import City
from agentspec.envs.deliverybench.view.cards import SERVICES, metres
from agentspec.envs.deliverybench.view.wording import HERE, at, duration
from agentspec.envs.deliverybench.world.food import MENU
from agentspec.envs.deliverybench.world.rules import Rules

_PLANNED = '{"action": "WAIT(60)", "plan": "then fetch 3 and 5"}'


def instruction(city: City, rules: Rules, shift_hours: float, compact: bool, menu: bool) -> str:
    """The instruction: for the menu and compact texts a short one, in full texts with prices and all places."""
    goal = (
        f"You are a delivery courier. Earn as much money as you can before the shift of "
        f"{duration(shift_hours * 3600.0)} ends: accept orders, pick the food up when it is ready, put it into your "
        "bag, and hand it over in time and the way the customer's note asks for."
    )
    if menu and compact:
        return f"{goal}\n\n{_listed(_brief(rules))}"
    if menu:
        lines = [*_reach(rules, compact), *_trade(rules, menu), *_numbers(rules), *_menu(rules)]
        return f"{goal}\n\n{_listed(lines)}"
    lines = ["Coordinates are metres, x east, y north; write them with the unit m.", *_reach(rules, compact)]
    lines += [*_trade(rules, menu), *_numbers(rules), *_habits(rules, compact)]
    parts = [goal, _listed(lines), _prices(rules)]
    if not compact:
        parts += [_dishes(), _places(city)]
    return "\n\n".join(parts)


def _listed(lines: list[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _reach(rules: Rules, compact: bool) -> list[str]:
    reach = f"{rules.nearby / 100:.0f}m"
    lines = [
        f'You act on what is within {reach} of you; it is marked "{HERE}". Distances are ways along the streets'
        + ("." if compact else ", those beside a place from where you are."),
        "A dish stands with the temperature to serve it at; "
        + ("once fetched as now/serve: Burger 58/60C." if compact else "in hands and bag with the one it has now."),
    ]
    if not compact:
        lines.append("An offer stands with its pay, the way from restaurant to customer, and the time allowed.")
    return lines


def _trade(rules: Rules, menu: bool) -> list[str]:
    """How money is made."""
    lines = [
        f"When you accept, the time allowed begins, and the restaurant starts cooking ({_cooking()}). An order pays "
        f"about ${rules.pay_per_km:.0f} per km, plus up to ${rules.bonus[5]:.0f} for five stars. From "
        f"{rules.grace:.0f}s late on the pay shrinks, down to {100 * rules.late_floor:.0f} %; what is undelivered when "
        "the shift ends pays nothing.",
        "Stars: time first, then food (temperature, smell, damage), then the hand-over the note asks for.",
        f"Carry several orders at once{_most(rules)} when their restaurants and customers lie on one way; finish what "
        "you accepted.",
    ]
    if not menu:
        lines.append(
            "Bag hot, cold and smelly food apart. The pace accel is a quarter faster, "
            "uses a quarter more energy and battery per metre, and shakes fragile food."
        )
        if not rules.ride_with_food_in_hand:
            lines.append("No vehicle moves while you hold food in your hands: bag it first.")
    return lines


def _cooking() -> str:
    """The range of the dishes' preparation times: `1 to 7 min`."""
    times = [food.prep / 60.0 for food in MENU]
    return f"{max(1, math.floor(min(times)))} to {math.ceil(max(times))} min"


def _most(rules: Rules) -> str:
    return "" if rules.max_active_orders is None else f" (at most {rules.max_active_orders})"


def _dishes() -> str:
    """Which dishes are fragile, and which smell."""
    fragile = ", ".join(food.name for food in MENU if food.fragile)
    return f"Fragile: {fragile}. Smelly: {', '.join(food.name for food in MENU if food.smells)}."


def _numbers(rules: Rules) -> list[str]:
    speed, energy = rules.speed, rules.energy_per_m
    return [
        f"Speed m/s: walk {speed['walk'] / 100:g}, e-scooter {speed['e-scooter'] / 100:g}, dragging it "
        f"when its battery is empty {speed['drag_scooter'] / 100:g}, car {speed['car'] / 100:g}.",
        f"Energy %/km: walk {energy['walk'] * 1000:g}, e-scooter {energy['e-scooter'] * 1000:g}, car "
        f"{energy['car'] * 1000:g}; at 0 you wake up in hospital {rules.hospital_seconds / 60:.0f} min later, "
        f"${rules.hospital_fee:.0f} poorer. The scooter's battery loses {rules.battery_per_m * 1000:g} %/km.",
        f"Charging adds {rules.charge_per_min:g} %/min (${rules.charge_price:.2f} per %), also while you walk away; "
        f"resting adds {rules.rest_per_min:g} %/min.",
    ]


def _habits(rules: Rules, compact: bool) -> list[str]:
    """What a courier should and should not do over and over."""
    cost = "" if rules.free_looks else f" (that costs {rules.look_seconds:.0f}s)"
    board = "The best offers are always shown, all of them after VIEW_ORDERS()"
    if not compact:
        board = "Offers stay until you accept them, and new ones take their place. VIEW_ORDERS() shows them"
    board += f" until you accept, move or work; do not look again while they are shown{cost}. Accept all you want of "
    board += "them in one action."
    return [
        board,
        "Otherwise only moving, waiting, resting and the bus take time.",
        "Do not repeat an action that has just failed: read why.",
        "Plan the next stops and keep to the plan until something changes."
        + ("" if compact else f" Any answer may be JSON that carries it, {_PLANNED}: it is shown to you again."),
    ]


def _menu(rules: Rules) -> list[str]:
    """How to read the menu."""
    return [
        '"hurry" is a quarter faster than "go", but shakes fragile food and drains more per metre. A rented car costs '
        f"${rules.rental_per_min:.0f} a minute until it is returned; a drink gives energy, a pack fills the battery.",
        '"more choices" turns the page and takes no time. What stands in brackets behind a choice is no part of it.',
    ]


def _brief(rules: Rules) -> list[str]:
    """All a small model needs for the menu."""
    return [
        f"An order pays about ${rules.pay_per_km:.0f} per km and up to ${rules.bonus[5]:.0f} for good service; late, "
        "cold or shaken food pays less, and food not delivered when the shift ends nothing.",
        "Carry several orders at once when they lie on one way; finish what you accepted.",
        f"Charge before the battery is empty, or rent a car: twice as fast, ${rules.rental_per_min:.0f} a minute.",
        '"hurry" is faster than "go", but shakes fragile food. "more choices" shows the others, without loss of time.',
        "Beside an offer: pay, way to the restaurant + on to the customer, time allowed.",
    ]


def _prices(rules: Rules) -> str:
    goods = ", ".join(f"{item} ${price:.0f}" for item, price in sorted(rules.prices.items()))
    return (
        f"Stores sell: {goods}. A drink gives {rules.drink_gain:.0f} % energy, a battery pack fills the scooter's "
        f"battery, an ice or heat pack keeps a compartment cold or hot. A car costs ${rules.rental_per_min:.2f} per "
        f"minute until you return it and needs no charging; the bus ${rules.bus_fare:.2f}."
    )


def _places(city: City) -> str:
    lines = ["Places:"]
    for kind in ("restaurant", *SERVICES):
        names = [f"{poi.name} {at(metres(poi.anchor))}" for poi in city.pois_of(kind)]
        if names:
            lines.append("; ".join(names))
    return "\n".join(lines)
