"""Snapshots: the state of a world as bytes and back, exactly.

JSON keeps every float to the last bit (``repr`` round-trips) and can be read by nothing but a JSON parser, so a blob
from elsewhere can at worst be refused. Orders are stored as numbers, because the order book can draw them again; food
items are stored once and referred to by number, because an order and the bag may hold the same item (or, under the
original rules, no longer the same).
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import fields
from typing import Any

from agentspec.envs.deliverybench.world.bag import LABELS, Bag, Item
from agentspec.envs.deliverybench.world.food import MENU
from agentspec.envs.deliverybench.world.orders import OrderBook
from agentspec.envs.deliverybench.world.recorder import Recorder
from agentspec.envs.deliverybench.world.rules import Rules
from agentspec.envs.deliverybench.world.settlement import Settlement
from agentspec.envs.deliverybench.world.state import Car, Charging, HelpRequest, Notice, OrderState, Scooter, State

VERSION = 2

_PLAIN = (
    "position",
    "energy",
    "balance",
    "pool",
    "next_order",
    "tick",
    "yaw",
    "mode",
    "pace",
    "ledger",
    "inventory",
    "recent",
    "error",
    "calls",
    "parse_errors",
    "hospital_until",
    "interrupt_at",
    "riding_to",
    "hands_at",
    "reason",
)
_SETTLEMENT = tuple(field.name for field in fields(Settlement))


def dump(state: State, recorder: Recorder, identity: list[Any]) -> bytes:
    """All of a world that is not a function of city, rules and seed; these are named by ``identity``."""
    table: dict[int, int] = {}
    items: list[list[Any]] = []

    def refs(group: Iterable[Item]) -> list[int]:
        numbers = []
        for item in group:
            number = table.get(id(item))
            if number is None:
                number = table[id(item)] = len(items)
                items.append(_item(item))
            numbers.append(number)
        return numbers

    scooter, car, session = state.scooter, state.car, state.charging
    data = {
        "version": VERSION,
        "world": identity,
        "state": [getattr(state, name) for name in _PLAIN],
        "scooter": [scooter.battery, scooter.state, scooter.park],
        "car": None if car is None else [car.since, car.state, car.park],
        "charging": None if session is None else [session.since, session.first, session.target, session.cost],
        "orders": [
            [number, order.accepted, order.pick_score, order.picked, refs(order.items), refs(order.pending)]
            for number, order in state.orders.items()
        ],
        "bag": [state.bag.tick, [[c.air, refs(c.items)] for c in state.bag.compartments.values()]],
        "items": items,
        "settlements": [[getattr(s, name) for name in _SETTLEMENT] for s in state.settlements],
        "requests": [[r.id, r.kind, r.bounty, r.seconds] for r in state.requests],
        "notices": [[notice.kind, notice.text, dict(notice.data)] for notice in state.notices],
        "recorder": recorder.dump(),
    }
    return json.dumps(data, separators=(",", ":")).encode()


def load(blob: bytes, rules: Rules, book: OrderBook, identity: list[Any]) -> tuple[State, Recorder]:
    """State and recorder of a `dump`.

    Raises:
        ValueError: the bytes are no snapshot of this version, or of another world.
    """
    try:
        data = json.loads(blob)
        if data["version"] != VERSION:
            raise ValueError(f"version {data['version']!r}, expected {VERSION}")
        if data["world"] != identity:
            raise ValueError(f"it is of world {data['world']}, this one is {identity}: restore it where it was taken")
        return _state(data, rules, book), Recorder.load(data["recorder"])
    except (KeyError, TypeError, IndexError, AttributeError, ValueError) as error:
        raise ValueError(f"not a snapshot of this delivery world ({type(error).__name__}: {error})") from error


def _state(data: dict[str, Any], rules: Rules, book: OrderBook) -> State:
    items = [_from_item(row) for row in data["items"]]
    plain = dict(zip(_PLAIN, data["state"], strict=True))
    plain["position"] = _point(plain["position"])
    battery, condition, park = data["scooter"]
    bag = Bag(rules)
    bag.tick, compartments = data["bag"]
    for label, (air, numbers) in zip(LABELS, compartments, strict=True):
        bag.compartments[label].air = air
        bag.compartments[label].items = [items[n] for n in numbers]
    state = State(scooter=Scooter(battery, condition, _point(park)), bag=bag, **plain)
    if data["car"] is not None:
        since, condition, park = data["car"]
        state.car = Car(since, condition, _point(park))
    if data["charging"] is not None:
        state.charging = Charging(*data["charging"])
    for number, accepted, score, picked, held, pending in data["orders"]:
        state.orders[number] = OrderState(
            book[number], accepted, score, picked, [items[n] for n in held], [items[n] for n in pending]
        )
    for row in data["settlements"]:
        values: list[Any] = [tuple(value) if isinstance(value, list) else value for value in row]
        state.settlements.append(Settlement(*values))
    state.requests = [HelpRequest(*row) for row in data["requests"]]
    state.notices = [Notice(kind, text, facts) for kind, text, facts in data["notices"]]
    return state


def _item(item: Item) -> list[Any]:
    food = -1 if item.food is None else item.food.index
    return [
        item.name,
        food,
        item.order_id,
        item.capacity,
        item.temp,
        item.odour,
        item.damage,
        item.ready_at,
        item.picked_at,
    ]


def _from_item(row: list[Any]) -> Item:
    name, food, *rest = row
    return Item(name, None if food < 0 else MENU[food], *rest)


def _point(value: Any) -> Any:
    return None if value is None else (value[0], value[1])
