"""The order pool: which orders exist, how each is drawn, and how good a choice it was.

Orders are numbered from 0 and every order has a random generator of its own, keyed by (seed, number). So the n-th order
of a city and seed is always the same, however the courier plays, and an `OrderBook` can be shared by all worlds of that
city and seed: a world only remembers numbers. The pool always shows ``pool_size`` orders; accepted ones are replaced
at once, and orders never expire. ``seed=None`` is the sequence of the original runner, which seeds nothing.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from agentspec.envs.deliverybench.world.food import MENU, Food, longest_prep
from agentspec.envs.deliverybench.world.notes import HAND, NOTES
from agentspec.envs.deliverybench.world.rules import Rules

if TYPE_CHECKING:
    from agentspec.envs.deliverybench.city.citymap import City, Poi

Point = tuple[float, float]

UNSEEDED = 0x13A5B6C7D8E9F123
_GOLDEN, _MIX, _MASK = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, (1 << 64) - 1
_BOX_SCALE = 1.2
_HANDOFF_TRIES = 50


@dataclass(frozen=True, slots=True)
class Offer:
    """One order as the platform offers it (facts only; what happens to it is `state.OrderState`).

    ``distance`` is the shortest way from door to door (cm), ``limit`` the seconds from acceptance to the deadline,
    ``pay`` the base wage (dollars), ``prep`` the seconds until the restaurant is ready. ``methods`` is empty when every
    hand-over is welcome; ``handoff`` is the point (cm) where the customer takes it by hand, else None.
    """

    id: int
    pickup: Poi
    dropoff: Poi
    foods: tuple[Food, ...]
    distance: float
    pay: float
    limit: float
    pay_jitter: float
    time_jitter: float
    prep: int
    note: str
    methods: tuple[str, ...]
    handoff: Point | None


class OrderBook:
    """All orders of one city, rule set and seed, drawn on demand and kept.

    Raises:
        ValueError: the city has no restaurant or no plain building.
    """

    def __init__(self, city: City, rules: Rules, seed: int | None) -> None:
        self._city = city
        self._rules = rules
        self._base = UNSEEDED if seed is None else seed
        places = sorted(city.pois, key=lambda poi: poi.json_index)
        self._restaurants = [poi for poi in places if poi.kind == "restaurant"]
        self._buildings = [poi for poi in places if poi.instance_name.startswith("BP_Building")]
        self._homes = [poi for poi in places if poi.kind == "building"]
        if not self._restaurants or not self._homes:
            raise ValueError(
                f"city {city.name!r} has {len(self._restaurants)} restaurants and {len(self._homes)} plain buildings; "
                "orders need at least one of each"
            )
        self._home_of: dict[str, Poi] = {}
        self._offers: dict[int, Offer] = {}

    def __deepcopy__(self, memo: object) -> OrderBook:
        """Itself: what it draws depends on nothing but the number, and copies of a world share it."""
        return self

    def __getitem__(self, number: int) -> Offer:
        offer = self._offers.get(number)
        if offer is None:
            offer = self._offers[number] = self._draw(number)
        return offer

    def _draw(self, number: int) -> Offer:
        rules = self._rules
        rng = random.Random((self._base ^ ((number + _GOLDEN) * _MIX)) & _MASK)
        pickup = rng.choice(self._restaurants)
        dropoff = self._home(rng.choice(self._buildings))
        foods = tuple(rng.sample(MENU, rng.randint(1, 4)))
        pay_jitter = rng.uniform(0.75, 1.35)
        time_jitter = rng.uniform(0.85, 1.25)
        note, methods = rng.choice(NOTES) if rng.random() < rules.note_probability else ("", ())
        handoff = _handoff(rng, dropoff) if HAND in methods else None
        distance = self._city.door_distance(pickup, dropoff)
        metres = distance / 100.0
        prep = longest_prep(foods)
        limit = max(metres / rules.eta_speed * rules.eta_slack * time_jitter, prep + 60.0)
        pay = rules.pay_per_km * (metres / 1000.0) * pay_jitter
        return Offer(
            number, pickup, dropoff, foods, distance, pay, limit, pay_jitter, time_jitter, prep, note, methods, handoff
        )

    def _home(self, building: Poi) -> Poi:
        """The plain building nearest to a drawn building: itself, or the neighbour of a shop."""
        if building.kind == "building":
            return building
        home = self._home_of.get(building.id)
        if home is None:
            home = min(self._homes, key=lambda poi: math.dist(poi.center, building.center))
            self._home_of[building.id] = home
        return home


def _handoff(rng: random.Random, dropoff: Poi) -> Point:
    """Where the customer waits: 5 to 10 m from the door, outside the building."""
    x, y = dropoff.anchor
    for _ in range(_HANDOFF_TRIES):
        angle = rng.uniform(0.0, 2.0 * math.pi)
        radius = rng.uniform(500.0, 1000.0)
        point = (x + radius * math.cos(angle), y + radius * math.sin(angle))
        if not _inside(point, dropoff):
            return (round(point[0], 4), round(point[1], 4))
    dx, dy = x - dropoff.center[0], y - dropoff.center[1]
    norm = math.hypot(dx, dy) or 1.0
    return (round(x + 1000.0 * dx / norm, 4), round(y + 1000.0 * dy / norm, 4))


def _inside(point: Point, building: Poi) -> bool:
    """Whether a point lies in the building's footprint, enlarged by 1.2 and rotated by its yaw."""
    yaw = math.radians(building.yaw)
    dx, dy = point[0] - building.center[0], point[1] - building.center[1]
    along = dx * math.cos(yaw) + dy * math.sin(yaw)
    across = -dx * math.sin(yaw) + dy * math.cos(yaw)
    half_x, half_y = _BOX_SCALE * building.bbox[0] / 2.0, _BOX_SCALE * building.bbox[1] / 2.0
    return abs(along) <= half_x and abs(across) <= half_y


def pick_scores(city: City, pool: Sequence[Offer], anchors: Iterable[Point]) -> dict[int, float]:
    """Score of each pooled order from 1 (poor choice) to 5 (good), by id.

    The pool is ranked three times: by nearness (mean of the network distances from pickup and from drop-off to the
    nearest of ``anchors``), by pay jitter and by time jitter, both descending. Rank r of n gives 1 - (r-1)/(n-1); the
    score is 1 + 4 times the mean of the three. ``anchors`` are the restaurants of the orders already accepted, or the
    courier's position when there are none (cm).
    """
    n = len(pool)
    if n < 2:
        return {offer.id: 5.0 for offer in pool}
    distances = _anchor_distances(city, pool, list(anchors))
    keys = (
        lambda offer: distances[offer.id],
        lambda offer: -offer.pay_jitter,
        lambda offer: -offer.time_jitter,
    )
    totals = dict.fromkeys((offer.id for offer in pool), 0.0)
    for key in keys:
        for rank, offer in enumerate(sorted(pool, key=key)):
            totals[offer.id] += 1.0 - rank / (n - 1)
    return {number: 1.0 + 4.0 * total / len(keys) for number, total in totals.items()}


def _anchor_distances(city: City, pool: Sequence[Offer], anchors: list[Point]) -> dict[int, float]:
    fields = {anchor: city.distances_from(anchor) for anchor in anchors}

    def nearest(poi: Poi) -> float:
        close = sorted(fields, key=lambda anchor: math.dist(anchor, poi.anchor))[:6]
        return min(fields[anchor].to(poi) for anchor in close)

    return {offer.id: (nearest(offer.pickup) + nearest(offer.dropoff)) / 2.0 for offer in pool}
