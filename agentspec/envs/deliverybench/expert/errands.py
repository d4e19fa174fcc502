"""Keeping a courier going: vehicle, battery and energy.

The economics decide. A rented car costs a dollar a minute, drives twice as fast as the scooter and needs no battery; a
battery pack is 2.5 km for ten dollars at once, a charger the same for five dollars and thirteen minutes; an energy
drink is 50 % for six dollars at once, a rest area the same for nothing and seven minutes. While orders are worth more
than ten dollars a kilometre, time is dearer than any of these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.calls import View, within_reach

DRINK, PACK = "energy_drink", "escooter_battery_pack"
ACTION_S = 15.0
"""About what an action takes, where their number and not the shift limits what lies ahead."""

RIDE = 'SWITCH(to="e-scooter")'


@dataclass(frozen=True, slots=True)
class Upkeep:
    """When to look after oneself.

    Attributes:
        car: rent a car when the shift leaves at least `car_from` seconds, and `car_actions` where actions are limited.
        energy_per_s: expected use of energy (%/s), for the number of drinks to buy.
        battery_per_s: expected use of battery (%/s) on the scooter.
        drink_below: drink when energy is at most this.
        detour_m: longest detour to a store that is made before it is urgent.
        reserve: dollars not to be spent in a store.
    """

    car: bool = True
    car_from: float = 900.0
    car_actions: int = 40
    energy_per_s: float = 0.085
    battery_per_s: float = 0.12
    drink_below: float = 50.0
    detour_m: float = 150.0
    reserve: float = 5.0


def regain(view: View) -> str | None:
    """Get back onto a vehicle after charging or a stay in hospital."""
    if view["mode"] != "walk":
        return None
    car = view["car"]
    if car is not None and car["at"] is not None:
        return 'SWITCH(to="car")' if within_reach(view, car["at"]) else calls.move(car["at"])
    scooter = view["scooter_xy"]
    if scooter is None or car is not None:
        return None
    if within_reach(view, scooter):
        return 'WAIT("charge_done")' if view["charging"] is not None else RIDE
    return calls.move(scooter)


def wants_car(view: View, upkeep: Upkeep) -> bool:
    """Whether renting a car pays: there is a rental, no car yet, money, and enough of the shift left."""
    rental = view["nearest"].get("car_rental")
    if not upkeep.car or view["car"] is not None or rental is None or view["balance"] < 30.0:
        return False
    if view.get("calls_left") is not None and view["calls_left"] < upkeep.car_actions:
        return False
    return bool(view["left_s"] - rental["m"] / view["speed"] >= upkeep.car_from)


def fetch_car(view: View) -> str:
    """The next action on the way to a rented car."""
    rental = view["nearest"]["car_rental"]
    return "RENT_CAR()" if within_reach(view, rental["xy"]) else calls.move(rental["xy"])


def close_car(view: View) -> str | None:
    """Bring the car back when nothing is left to deliver and the rent of the rest of the shift is worth the way."""
    rental = view["nearest"].get("car_rental")
    if view["car"] is None or view["mode"] != "car" or rental is None:
        return None
    if within_reach(view, rental["xy"]):
        return "RETURN_CAR()"
    return calls.move(rental["xy"]) if rental["m"] / view["speed"] < 0.8 * view["left_s"] else None


def refresh(view: View, upkeep: Upkeep) -> str | None:
    """Use what is carried, when it is needed and nothing of it is wasted."""
    if view["energy"] <= upkeep.drink_below and view["inventory"].get(DRINK):
        return "USE_ENERGY_DRINK()"
    if view["mode"] == "drag_scooter" and view["inventory"].get(PACK):
        return "USE_BATTERY_PACK()"
    return None


def power(view: View, leg_m: float) -> str | None:
    """Battery for the next `leg_m` metres on the scooter: a pack if carried, else the way to a store or charger."""
    if view["mode"] not in ("e-scooter", "drag_scooter"):
        return None
    spare = 40.0
    if view["range_m"] >= leg_m + spare and view["mode"] == "e-scooter":
        station = view["nearest"].get("charging_station")
        if station is None or view["range_m"] >= leg_m + spare + 250.0 or view["inventory"].get(PACK):
            return None
    if view["inventory"].get(PACK):
        return "USE_BATTERY_PACK()"
    return _refill(view)


def _refill(view: View) -> str | None:
    """Go and buy a pack, or charge: whatever costs less of the remaining shift."""
    store, station = view["nearest"].get("store"), view["nearest"].get("charging_station")
    price = 10.0
    if store is not None and view["balance"] >= price + 5.0 and (station is None or store["m"] <= station["m"] + 600.0):
        if view["left_s"] < 300.0:
            return None
        return _buy(view, {PACK: 1}) if within_reach(view, store["xy"]) else calls.move(store["xy"])
    if station is None or view["left_s"] < 400.0:
        return None
    if not within_reach(view, station["xy"]):
        return calls.move(station["xy"])
    needed = view["battery"] + 0.1 * view["left_s"]
    return f"CHARGE(target_pct={min(100, math.ceil(needed))})"


def shopping(view: View, upkeep: Upkeep, goal: Sequence[float] | None, metres: float) -> str | None:
    """Buy drinks and packs: when they are urgent, or when a store lies near the way to `goal` (`metres` away).

    Returns:
        the next action, None when nothing is needed or no store is worth the detour.
    """
    store = view["nearest"].get("store")
    needs = wanted(view, upkeep)
    if store is None or not needs:
        return None
    if within_reach(view, store["xy"]):
        return _buy(view, needs)
    urgent = view["energy"] + 50.0 * view["inventory"].get(DRINK, 0) <= 25.0
    if not urgent and goal is not None:
        detour = store["m"] + calls.distance(store["xy"], goal) - metres
        urgent = detour <= upkeep.detour_m
    return calls.move(store["xy"]) if urgent else None


def wanted(view: View, upkeep: Upkeep) -> dict[str, int]:
    """What to buy for the rest of the shift, as far as the money goes."""
    money = view["balance"] - upkeep.reserve
    shopping_list = {}
    on_scooter = view["car"] is None
    left = view["left_s"] if view.get("calls_left") is None else min(view["left_s"], ACTION_S * view["calls_left"])
    energy_need = left * upkeep.energy_per_s * (0.6 if on_scooter else 1.0)
    drinks = math.ceil((energy_need - view["energy"] - 50.0 * view["inventory"].get(DRINK, 0)) / 50.0)
    if drinks > 0 and money >= 6.0:
        shopping_list[DRINK] = count = min(drinks, int(money // 6.0))
        money -= 6.0 * count
    if on_scooter and not upkeep.car:
        packs = math.ceil(
            (left * upkeep.battery_per_s - view["battery"] - 100.0 * view["inventory"].get(PACK, 0)) / 100.0
        )
        if packs > 0 and money >= 10.0:
            shopping_list[PACK] = min(packs, int(money // 10.0))
    return shopping_list


def _buy(view: View, items: dict[str, int]) -> str:
    entries = ", ".join(f'{{"item_id": "{item}", "qty": {count}}}' for item, count in items.items())
    return f"BUY(items=[{entries}])"
