"""What a courier could do next for vehicle, battery and energy: the other half of the menu, beside `choices`."""

from __future__ import annotations

from collections.abc import Sequence

from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.calls import View, within_reach
from agentspec.envs.deliverybench.view.choices import DRINK, GOODS, HEAT, ICE, PACK, Option
from agentspec.envs.deliverybench.view.wording import duration

LEVELS = (80.0, 100.0, 60.0, 40.0)
"""Battery and energy levels on offer (%), best first."""

SHORT_WAIT_S, LONG_WAIT_S = 60.0, 300.0

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
