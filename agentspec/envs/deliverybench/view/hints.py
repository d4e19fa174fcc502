"""What can be done where the courier stands, as native calls: the arrival hints of the texts.

One line per possibility, complete enough to be copied: which orders are ready here, which hand-over the customer wants,
how the food in the hand fits into the bag, what a charger, store, rental, stop or rest area here offers.
"""

from __future__ import annotations

from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.calls import Card, View, within_reach
from agentspec.envs.deliverybench.view.cards import IN_BAG, IN_HAND, PREPARING, READY
from agentspec.envs.deliverybench.view.choices import DRINK, PACK
from agentspec.envs.deliverybench.view.wording import at, duration, exactly, joined
from agentspec.envs.deliverybench.world.notes import HAND, METHODS


def hints(view: View) -> list[str]:
    """The lines, work first; empty where nothing can be done."""
    return [*_deliveries(view), *_bagging(view), *_kitchen(view), *_vehicle(view), *_services(view), *_goods(view)]


def _deliveries(view: View) -> list[str]:
    lines = []
    for order in view["orders"]:
        if order["status"] not in (IN_BAG, IN_HAND):
            continue
        at_door = within_reach(view, order["dropoff_xy"])
        at_customer = order["handoff_xy"] is not None and within_reach(view, order["handoff_xy"])
        if at_door or at_customer:
            lines.append(_delivery(order, at_customer))
    return lines


def _delivery(order: Card, at_customer: bool) -> str:
    number, wanted = order["id"], list(order["methods"])
    if not wanted:
        note = f'the note says: "{order["note"]}"' if order["note"] else "there is no note: any method will do"
        return f"deliver: DROP_OFF(oid={number}, method=...), one of {joined(METHODS)}; {note}"
    possible = [m for m in wanted if m != HAND or at_customer] if order["handoff_xy"] is not None else wanted
    if not possible:
        return f"order {number} must be handed over in person: the customer waits at {at(order['handoff_xy'])}"
    says = f"the note asks for {joined(wanted)}" if order["note"] else "any method will do"
    return f'deliver: DROP_OFF(oid={number}, method="{possible[0]}"); {says}'


def _bagging(view: View) -> list[str]:
    hand = [order for order in view["orders"] if order["hand"]]
    return [f"pack, for example: {calls.bag(view, hand)}"] if hand else []


def _kitchen(view: View) -> list[str]:
    here = [order for order in view["orders"] if within_reach(view, order["pickup_xy"])]
    ready = [order["id"] for order in here if order["status"] == READY]
    lines = [f"fetch: {calls.pick_up(ready)}"] if ready else []
    for order in here:
        if order["status"] == PREPARING:
            lines.append(f"wait until order {order['id']} is ready: {calls.wait(order['ready_in_s'])}")
    return lines


def _vehicle(view: View) -> list[str]:
    lines = []
    if view["mode"] != "e-scooter" and view["scooter_xy"] is not None and within_reach(view, view["scooter_xy"]):
        if view["charging"] is not None:
            lines.append('wait until your scooter is charged: WAIT("charge_done")')
        lines.append('your scooter stands here: SWITCH(to="e-scooter")')
    car = view["car"]
    if car is not None and car["at"] is not None and within_reach(view, car["at"]):
        lines.append('your car stands here: SWITCH(to="car")')
    return lines


def _services(view: View) -> list[str]:
    near = {kind: place for kind, place in view["nearest"].items() if within_reach(view, place["xy"])}
    lines = []
    scooter = view["scooter_xy"] is None or within_reach(view, view["scooter_xy"])
    if "charging_station" in near and scooter and view["charging"] is None and view["battery"] < 99.5:
        missing = 100.0 - view["battery"]
        price, time = missing * view["charge_price"], duration(60.0 * missing / view["charge_per_min"])
        lines.append(f"charge: CHARGE(target_pct=100) takes {time} and costs ${price:.2f}; a lower target less")
    if "rest_area" in near and view["energy"] < 99.5:
        time = duration(60.0 * (100.0 - view["energy"]) / view["rest_per_min"])
        lines.append(f"rest: REST(target_pct=100) takes {time}; a lower target less")
    if "store" in near:
        goods = joined([item for item in view["prices"] if item != DRINK])
        lines.append(f'shop: BUY(item_id="{DRINK}", qty=1), or {goods}')
    if "car_rental" in near:
        lines.append("rent a car: RENT_CAR()" if view["car"] is None else "give the car back: RETURN_CAR()")
    return [*lines, *_bus(view)]


def _bus(view: View) -> list[str]:
    line = view["bus"]
    if line is None or not line["here"]:
        return []
    if not (line["stopped"] and line["stop"] == line["here"]):
        return [f"the bus will stand here in {exactly(line['here_s'])}"]
    goals = [stop for stop in dict.fromkeys(line["stops"]) if stop != line["here"]]
    return (
        [f'ride the bus: BOARD_BUS(bus_id="bus_1", target_stop_id="{goals[0]}"), or to {joined(goals[1:])}']
        if goals
        else []
    )


def _goods(view: View) -> list[str]:
    held, lines = view["inventory"], []
    if held.get(DRINK) and view["energy"] <= 50.0:
        lines.append("drink: USE_ENERGY_DRINK()")
    usable = view["scooter_xy"] is None or within_reach(view, view["scooter_xy"])
    if held.get(PACK) and usable and view["battery"] <= 50.0:
        lines.append("fill the battery: USE_BATTERY_PACK()")
    return lines
