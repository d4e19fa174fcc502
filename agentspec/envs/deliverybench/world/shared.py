"""What all worlds of one city share: order books and bus timetables, functions of city, rules and seed alone."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

from agentspec.envs.deliverybench.city.citymap import City
from agentspec.envs.deliverybench.world.bus import BusTimetable
from agentspec.envs.deliverybench.world.orders import OrderBook
from agentspec.envs.deliverybench.world.rules import Rules

_cache: WeakKeyDictionary[City, dict[Any, Any]] = WeakKeyDictionary()


def shared(city: City, rules: Rules, seed: int | None) -> tuple[OrderBook, BusTimetable]:
    """The order book and the timetable of a world."""
    store = _cache.setdefault(city, {})
    order_rules = (rules.note_probability, rules.pay_per_km, rules.eta_speed, rules.eta_slack)
    book_key = ("book", seed, order_rules)
    book = store.get(book_key)
    if book is None:
        books = [key for key in store if key[0] == "book"]
        for key in books[:-64]:
            del store[key]
        book = store[book_key] = OrderBook(city, rules, seed)
    bus_key = ("bus", rules.bus_dwell, rules.speed["bus"], rules.odd_bus_line)
    timetable = store.get(bus_key)
    if timetable is None:
        line = city.bus
        timetable = store[bus_key] = BusTimetable(line.stop_names, line.stops, line.points, rules)
    return book, timetable
