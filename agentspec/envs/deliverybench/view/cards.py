"""What a courier can know at one moment, as plain data.

`describe` turns a world into one JSON-like dict, in **metres**, seconds, percent and dollars. The observation text, the
menu, the scripted couriers and `info["state"]` are all made from it and from nothing else, so none of them sees more
than the others. The orders on offer are always in it: looking at them (VIEW_ORDERS) takes no time in the world. What is
hidden in the world stays hidden: when an offer's food would be ready must be concluded from what it contains, and which
hand-over methods a note allows from the note (at the customer's they are told, unless the rules hide them).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Any

from agentspec.envs.deliverybench.city.citymap import Poi
from agentspec.envs.deliverybench.city.routing import DistanceField
from agentspec.envs.deliverybench.world.engine import World
from agentspec.envs.deliverybench.world.notes import METHODS
from agentspec.envs.deliverybench.world.orders import Offer, OrderBook
from agentspec.envs.deliverybench.world.state import OrderState, State

SERVICES = ("charging_station", "store", "rest_area", "car_rental", "hospital", "bus_station")
PREPARING, READY, IN_HAND, IN_BAG = "preparing", "ready", "in hand", "in bag"

Point = tuple[float, float]
Card = dict[str, Any]


class OfferCards:
    """The unchanging part of every order's description, made once per order book."""

    def __init__(self, book: OrderBook) -> None:
        self.book = book
        self._cards: dict[int, Card] = {}

    def __getitem__(self, number: int) -> Card:
        card = self._cards.get(number)
        if card is None:
            card = self._cards[number] = _card(self.book[number])
        return card


def metres(point: Point) -> list[float]:
    """A point in metres with two decimals, as a JSON list."""
    return [round(point[0] / 100.0, 2), round(point[1] / 100.0, 2)]


def describe(world: World, cards: OfferCards) -> dict[str, Any]:
    """Everything the courier of `world` can know now; see the module docstring."""
    state, rules = world.look(), world.rules
    field = world.city.distances_from(state.position)
    here = world.city.pois_near(state.position, rules.nearby)
    clock = state.tick / rules.ticks_per_second
    scooter = state.scooter
    return {
        "clock_s": round(clock, 1),
        "left_s": round(max(0.0, world.shift_hours * 3600.0 - clock), 1),
        "calls_left": None if world.max_calls is None else max(0, world.max_calls - state.calls),
        "position": metres(state.position),
        "place": here[0].name if here else "",
        "here": [poi.name for poi in here if poi.kind != "building"],
        "mode": state.mode,
        "pace": state.pace,
        "speed": rules.speed[state.mode] / 100.0,
        "energy": round(state.energy, 2),
        "battery": round(scooter.battery, 2),
        "range_m": round(scooter.battery / rules.battery_per_m, 0),
        "scooter": scooter.state,
        "scooter_xy": None if scooter.park is None else metres(scooter.park),
        "scooter_m": None if scooter.park is None else round(math.dist(scooter.park, state.position) / 100.0, 1),
        "car": _car(state),
        "charging": _charging(state, rules.charge_per_min),
        "balance": round(state.balance, 4),
        "net_earnings": round(state.balance - rules.initial_balance, 4),
        "inventory": {item: n for item, n in state.inventory.items() if n},
        "orders": [_order(world, order, cards, field) for order in state.orders.values()],
        "offers": [_offer(cards[number], cards.book[number], field) for number in state.pool],
        "room": None if rules.max_active_orders is None else max(0, rules.max_active_orders - len(state.orders)),
        "hands_must_be_free": not rules.ride_with_food_in_hand,
        "bag": _bag(state),
        "nearest": _nearest(world, field),
        "bus": _bus(world, clock),
        "prices": dict(rules.prices),
        "charge_per_min": rules.charge_per_min,
        "charge_price": rules.charge_price,
        "rest_per_min": rules.rest_per_min,
        "recent": list(state.recent),
        "error": state.error,
        "notices": [{"kind": notice.kind, "text": notice.text} for notice in state.notices],
    }


def state_hash(view: Mapping[str, Any]) -> str:
    """A short hash of what matters for the next decision, equal for states that differ only in small change: place to
    5 m, battery and energy to 10 %, clock to the minute, and the orders with their status."""
    x, y = view["position"]
    facts = (
        round(x / 5.0),
        round(y / 5.0),
        view["mode"],
        int(view["battery"] // 10),
        int(view["energy"] // 10),
        int(view["clock_s"] // 60),
        view["charging"] is not None,
        tuple((order["id"], order["status"]) for order in view["orders"]),
        tuple(offer["id"] for offer in view["offers"]),
        tuple(sorted(view["inventory"].items())),
    )
    return hashlib.blake2b(repr(facts).encode("utf-8"), digest_size=8).hexdigest()


def way(field: DistanceField, poi: Poi) -> int:
    """The way to a place in whole metres, off-street part included."""
    return round((field.to(poi) + field.gap) / 100.0)


def _card(offer: Offer) -> Card:
    return {
        "id": offer.id,
        "pickup": offer.pickup.name,
        "pickup_xy": metres(offer.pickup.anchor),
        "pickup_road": offer.pickup.road,
        "dropoff": offer.dropoff.name,
        "dropoff_xy": metres(offer.dropoff.anchor),
        "dropoff_road": offer.dropoff.road,
        "pay": round(offer.pay, 2),
        "distance_m": round(offer.distance / 100.0),
        "limit_s": round(offer.limit, 1),
        "items": [food.name for food in offer.foods],
        "note": offer.note,
    }


def _offer(card: Card, offer: Offer, field: DistanceField) -> Card:
    return {**card, "to_pickup_m": way(field, offer.pickup)}


def _order(world: World, order: OrderState, cards: OfferCards, field: DistanceField) -> Card:
    offer, rules = order.offer, world.rules
    elapsed = (world.state.tick - order.accepted) / rules.ticks_per_second
    ready_in = max(0.0, offer.prep - elapsed)
    return {
        **cards[offer.id],
        "status": _status(order, ready_in),
        "elapsed_s": round(elapsed, 1),
        "time_left_s": round(offer.limit - elapsed, 1),
        "ready_in_s": round(ready_in, 1) if order.picked is None else 0.0,
        "to_pickup_m": way(field, offer.pickup),
        "to_dropoff_m": way(field, offer.dropoff),
        "handoff_xy": None if rules.handoff_hidden or offer.handoff is None else metres(offer.handoff),
        "hand": [item.name for item in order.pending],
        "picked": order.picked is not None,
        "dishes": [
            {"name": item.name, "serve": item.food.serving, "temp": round(item.temp, 1)}
            for item in order.items
            if item.food is not None
        ]
        or [{"name": food.name, "serve": food.serving, "temp": None} for food in offer.foods],
        "methods": _methods(world, order),
    }


def _methods(world: World, order: OrderState) -> list[str]:
    """The hand-over methods the customer is content with, told to a courier who has come with the food; else empty."""
    offer, rules, here = order.offer, world.rules, world.state.position
    if order.picked is None or rules.methods_hidden:
        return []
    places = [offer.dropoff.anchor] + ([] if offer.handoff is None else [offer.handoff])
    arrived = any(math.dist(place, here) <= rules.nearby for place in places)
    return list(offer.methods or METHODS) if arrived else []


def _status(order: OrderState, ready_in: float) -> str:
    if order.picked is not None:
        return IN_HAND if order.pending else IN_BAG
    return PREPARING if ready_in > 0.0 else READY


def _car(state: State) -> dict[str, Any] | None:
    car = state.car
    if car is None:
        return None
    return {"at": None if car.park is None else metres(car.park), "minutes": round((state.tick - car.since) / 600.0, 1)}


def _charging(state: State, per_minute: float) -> dict[str, Any] | None:
    session = state.charging
    if session is None:
        return None
    missing = max(0.0, session.target - state.scooter.battery)
    return {"target": session.target, "left_s": round(missing / per_minute * 60.0, 1)}


def _bag(state: State) -> dict[str, Any]:
    return {
        label: {
            "air": round(compartment.air, 1),
            "items": [
                {"name": item.name, "order": item.order_id if item.food else None, "temp": round(item.temp, 1)}
                for item in compartment.items
            ],
        }
        for label, compartment in state.bag.compartments.items()
    }


def _nearest(world: World, field: DistanceField) -> dict[str, Any]:
    """The nearest place of each service kind by way: name, position, metres."""
    known: dict[str, Card] | None = field.memo.get("nearest")
    if known is None:
        known = {}
        for kind in SERVICES:
            places = world.city.pois_of(kind)
            if places:
                poi = min(places, key=field.to)
                known[kind] = {"name": poi.name, "xy": metres(poi.anchor), "m": way(field, poi)}
        # Stored when complete: worlds in other threads read it.
        field.memo["nearest"] = known
    return {kind: {**card} for kind, card in known.items()}


def _bus(world: World, clock: float) -> dict[str, Any] | None:
    """What the bus does, its stops, and at a stop (`here`) the seconds until it stands there."""
    timetable, state, rules = world.timetable, world.state, world.rules
    phase = timetable.phase(state.tick)
    if phase is None:
        return None
    stops = zip(timetable.names, timetable.stops, strict=True)
    here = next((name for name, stop in stops if math.dist(stop, state.position) <= rules.bus_tolerance), "")
    wait = (timetable.arrival(here, state.tick) - state.tick) / rules.ticks_per_second if here else None
    return {
        "stopped": phase.stopped,
        "stop": phase.stop,
        "target": phase.target,
        "left_s": round(max(0.0, phase.until - clock), 1),
        "stops": list(timetable.names),
        "here": here,
        "here_s": wait,
    }
