"""Procedural cities in the benchmark's own two-file format.

A city grows from the origin on a lattice of 200 m blocks: roads are added where they close a block or stay near the
centre, so the streets are connected and have loops. Buildings line both sides of every road with their fronts to it,
none overlapping another or standing on a street. Some become shops, spread over the city; chargers and one bus line
follow. Everything is drawn from (size, seed) alone, so the same pair always gives the same city, on every machine.

Seeds are split by range, so that a policy is never tested in a city it was trained in (see `split_of`).
"""

from __future__ import annotations

import json
import math
import random
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agentspec.envs.deliverybench.city.citymap import MEMORY_LIMIT, ROADS_FILE, WORLD_FILE, City, build_city, load_city
from agentspec.files import write_atomic

Cell = tuple[int, int]
Street = tuple[Cell, Cell]

SPLITS: Mapping[str, range] = {
    "train": range(0, 10_000),
    "validation": range(10_000, 20_000),
    "test": range(20_000, 30_000),
}
"""City seeds of each split (see `split_of`)."""

BLOCK_M = 200
FRONT_CM = 2700.0
CHARGER_OFFSET_CM = 1200.0
STOP_OFFSET_CM = 800.0
GAP_CM = 150.0
MIN_SIDE_CM, MAX_SIDE_CM = 1200.0, 5500.0


@dataclass(frozen=True, slots=True)
class Plan:
    """How much of everything a city of one size has: inclusive ranges, `buildings` being plain buildings per road."""

    roads: tuple[int, int]
    buildings: tuple[float, float]
    restaurant: tuple[int, int]
    store: tuple[int, int]
    rest_area: tuple[int, int]
    car_rental: tuple[int, int]
    chargers: tuple[int, int]
    stops: tuple[int, int]


PLANS: Mapping[str, Plan] = {
    "tiny": Plan((4, 6), (2.0, 3.0), (2, 2), (1, 1), (1, 1), (1, 1), (3, 3), (2, 2)),
    "small": Plan((11, 15), (6.2, 7.2), (4, 5), (4, 5), (1, 2), (1, 2), (10, 18), (4, 6)),
    "medium": Plan((18, 22), (5.6, 6.4), (5, 7), (6, 7), (2, 3), (2, 3), (18, 24), (6, 8)),
    "large": Plan((26, 35), (5.6, 6.4), (7, 9), (8, 11), (3, 4), (3, 4), (20, 29), (8, 10)),
}

_memory: dict[tuple[str, int], City] = {}
_lock = threading.Lock()


def split_of(seed: int) -> str:
    """The split a city seed belongs to: train 0-9999, validation 10000-19999, test 20000-29999."""
    for name, seeds in SPLITS.items():
        if seed in seeds:
            return name
    raise ValueError(f"city seed {seed} belongs to no split; expected 0 to {SPLITS['test'].stop - 1}")


def generate(size: str, seed: int) -> City:
    """The city of that size ("tiny", "small", "medium", "large") and seed, named "size-seed"."""
    key = (size, seed)
    with _lock:
        city = _memory.get(key)
        if city is None:
            while len(_memory) >= MEMORY_LIMIT:
                _memory.pop(next(iter(_memory)))
            city = _memory[key] = build_city(f"{size}-{seed}", *documents(size, seed))
        return city


def city_of(map: str | Path | None = None, size: str = "small", city_seed: int = 0) -> City:
    """The city an environment with these arguments runs in: the folder `map` if given, else a generated city."""
    return load_city(map) if map is not None else generate(size, city_seed)


def write_city(folder: str | Path, size: str, seed: int) -> Path:
    """Write the two map files of a city into `folder` (made if needed) and return it; `load_city` reads them back."""
    target = Path(folder)
    for name, document in zip((ROADS_FILE, WORLD_FILE), documents(size, seed), strict=True):
        write_atomic(target / name, json.dumps(document, indent=1).encode("utf-8"))
    return target


def documents(size: str, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Contents of `roads.json` and `progen_world_enriched.json` of a city."""
    if size not in PLANS:
        raise ValueError(f"there is no city size {size!r}; expected one of {', '.join(PLANS)}")
    if seed < 0:
        raise ValueError(f"got city seed {seed}; expected 0 or more")
    plan = PLANS[size]
    # A text seed is hashed by the generator itself, the same way on every platform.
    rng = random.Random(f"agentspec city {size} {seed}")
    streets = _streets(rng, rng.randint(*plan.roads))
    lots = _lots(rng, streets)
    shops = _shops(rng, lots, plan)
    kept = _thin(rng, lots, shops, round(rng.uniform(*plan.buildings) * len(streets)))
    nodes = [_building(lot, shops.get(i), number) for number, (i, lot) in enumerate(kept)]
    nodes += _chargers(rng, streets, rng.randint(*plan.chargers))
    stations, route = _bus(rng, streets, rng.randint(*plan.stops))
    roads = [{"start": _metres(a), "end": _metres(b), "is_highway": False} for a, b in streets]
    world = {"base_map": {"name": f"{size}-{seed}"}, "nodes": nodes + stations, "bus_routes": [route]}
    return {"roads": roads}, world


# -- streets -------------------------------------------------------------------------------------------------------


def _streets(rng: random.Random, count: int) -> list[Street]:
    """`count` lattice edges, connected, grown from the origin; the first leaves it."""
    streets: list[Street] = []
    joined: set[Cell] = {(0, 0)}
    while len(streets) < count:
        options = [
            (a, b) for a in sorted(joined) for b in _around(a) if (a, b) not in streets and (b, a) not in streets
        ]
        streets.append(rng.choices(options, [_appeal(a, b, joined) for a, b in options])[0])
        joined.add(streets[-1][1])
    return streets


def _around(cell: Cell) -> list[Cell]:
    x, y = cell
    return [(x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)]


def _appeal(a: Cell, b: Cell, joined: set[Cell]) -> float:
    # Closing a block makes alternatives for every later route; far out roads make errands long.
    closes = 3.0 if b in joined else 1.0
    return closes * math.exp(-0.35 * (abs(b[0]) + abs(b[1])))


# -- buildings -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Lot:
    """A building site (cm): centre, yaw (its front looks to yaw + 90 degrees), own width and depth, and world box."""

    center: tuple[float, float]
    yaw: int
    width: float
    depth: float
    box: tuple[float, float, float, float]


def _lots(rng: random.Random, streets: Sequence[Street]) -> list[Lot]:
    """As many building sites as fit along both sides of every road, in road order."""
    strips = [_strip(street) for street in streets]
    lots: list[Lot] = []
    for a, b in streets:
        for side in (1, -1):
            at = FRONT_CM + rng.uniform(0.0, 800.0)
            while True:
                width = _extent(rng)
                depth = _extent(rng)
                if at + width > BLOCK_M * 100 - FRONT_CM:
                    break
                lot = _lot(a, b, side, (at + width / 2.0, width, depth))
                if not any(_overlap(lot.box, other, GAP_CM) for other in [*strips, *(o.box for o in lots)]):
                    lots.append(lot)
                at += width + rng.uniform(GAP_CM, 900.0)
    return lots


def _extent(rng: random.Random) -> float:
    # Log-uniform: many small houses, a few large blocks.
    return round(MIN_SIDE_CM * (MAX_SIDE_CM / MIN_SIDE_CM) ** rng.random(), 2)


def _lot(a: Cell, b: Cell, side: int, measures: tuple[float, float, float]) -> Lot:
    along, width, depth = measures
    dx, dy = b[0] - a[0], b[1] - a[1]
    nx, ny = -dy * side, dx * side  # away from the road
    off = FRONT_CM + depth / 2.0
    x = round(a[0] * BLOCK_M * 100 + dx * along + nx * off, 2)
    y = round(a[1] * BLOCK_M * 100 + dy * along + ny * off, 2)
    front = {(0, 1): 90, (0, -1): 270, (1, 0): 0, (-1, 0): 180}[(-nx, -ny)]
    yaw = (front - 90) % 360
    half_x, half_y = (width / 2.0, depth / 2.0) if yaw in (0, 180) else (depth / 2.0, width / 2.0)
    return Lot((x, y), yaw, width, depth, (x - half_x, y - half_y, x + half_x, y + half_y))


def _strip(street: Street) -> tuple[float, float, float, float]:
    # The space of a road and its pavements, up to where fronts may begin; slightly less, so that fronts may touch it.
    (ax, ay), (bx, by) = ((c[0] * BLOCK_M * 100.0, c[1] * BLOCK_M * 100.0) for c in street)
    half = FRONT_CM - GAP_CM - 1.0
    return (min(ax, bx) - half, min(ay, by) - half, max(ax, bx) + half, max(ay, by) + half)


def _overlap(a: Sequence[float], b: Sequence[float], gap: float) -> bool:
    return a[0] < b[2] + gap and b[0] < a[2] + gap and a[1] < b[3] + gap and b[1] < a[3] + gap


def _shops(rng: random.Random, lots: Sequence[Lot], plan: Plan) -> dict[int, str]:
    """Kind by lot number for the lots that become shops, each kind spread out by choosing the best of three sites."""
    shops: dict[int, str] = {}
    for kind in ("restaurant", "store", "rest_area", "hospital", "car_rental"):
        low, high = getattr(plan, kind, (1, 1))
        for _ in range(rng.randint(low, high)):
            free = [i for i in range(len(lots)) if i not in shops]
            same = [lots[i].center for i, other in shops.items() if other == kind]
            best = max(rng.sample(free, min(3, len(free))), key=lambda i: _clearance(lots[i], same))
            shops[best] = kind
    return shops


def _clearance(lot: Lot, others: Sequence[tuple[float, float]]) -> float:
    return min((math.dist(lot.center, other) for other in others), default=0.0)


def _thin(rng: random.Random, lots: Sequence[Lot], shops: Mapping[int, str], plain: int) -> list[tuple[int, Lot]]:
    """All shops and `plain` of the other lots, with their numbers, in road order."""
    others = [i for i in range(len(lots)) if i not in shops]
    kept = set(rng.sample(others, min(plain, len(others)))) | set(shops)
    return [(i, lot) for i, lot in enumerate(lots) if i in kept]


def _building(lot: Lot, kind: str | None, number: int) -> dict[str, Any]:
    # The asset name follows from the footprint, so that equal houses look equal.
    asset = f"BP_Building_{int(lot.width + 31 * lot.depth) % 90 + 10}_C"
    properties: dict[str, Any] = {
        "location": {"x": lot.center[0], "y": lot.center[1], "z": 0.0},
        "orientation": {"pitch": 0.0, "yaw": float(lot.yaw), "roll": 0.0},
        "scale": {"x": 1.0, "y": 1.0, "z": 1.0},
        "bbox": {"x": lot.width, "y": lot.depth, "z": 3000.0},
    }
    if kind is not None:
        properties["poi_type"] = kind
    return {"id": f"GEN_{asset}_{number}", "instance_name": asset, "properties": properties}


# -- chargers and the bus --------------------------------------------------------------------------------------------


def _chargers(rng: random.Random, streets: Sequence[Street], count: int) -> list[dict[str, Any]]:
    """Chargers beside distinct roads while there are any, then beside random ones."""
    order = rng.sample(range(len(streets)), len(streets))
    order += [rng.randrange(len(streets)) for _ in range(count - len(streets))]
    nodes = []
    for k, i in enumerate(order[:count]):
        point = _beside(streets[i], rng.uniform(0.15, 0.85), CHARGER_OFFSET_CM * rng.choice((1, -1)))
        nodes.append(_point(f"GEN_POI_ChargingStation_{k}_{rng.randrange(1000)}", "charging_station", point))
    return nodes


def _bus(rng: random.Random, streets: Sequence[Street], count: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """A line of `count` roads, new ones first, with one stop along each; its path has one corner more than stops."""
    degree = {cell: sum(cell in street for street in streets) for cell in (c for s in streets for c in s)}
    path = [rng.choice([cell for cell in degree if degree[cell] == min(degree.values())])]
    used: dict[frozenset[Cell], int] = {}
    stations = []
    for k in range(count):
        here = path[-1]
        ways = [b if a == here else a for a, b in streets if here in (a, b)]
        fewest = min(used.get(frozenset((here, there)), 0) for there in ways)
        there = rng.choice([w for w in ways if used.get(frozenset((here, w)), 0) == fewest])
        used[frozenset((here, there))] = fewest + 1
        path.append(there)
        point = _beside((here, there), rng.uniform(0.25, 0.75), -STOP_OFFSET_CM)
        stations.append(_point(f"GEN_POI_BusStation_{k}_{rng.randrange(1000)}", "bus_station", point))
    route = {
        "type": "bus_route",
        "id": "route_bus_1",
        "station_ids": [station["id"] for station in stations],
        "path": [_metres(cell) for cell in path],
    }
    return stations, route


def _beside(street: Street, t: float, offset: float) -> tuple[float, float]:
    """A point `offset` cm left of a road (cm) at fraction `t` of its length."""
    (ax, ay), (bx, by) = street
    dx, dy = bx - ax, by - ay
    scale = BLOCK_M * 100.0
    return (round((ax + dx * t) * scale - dy * offset, 2), round((ay + dy * t) * scale + dx * offset, 2))


def _point(name: str, kind: str, point: tuple[float, float]) -> dict[str, Any]:
    instance = "POI_BusStation" if kind == "bus_station" else "POI_ChargingStation"
    properties = {
        "poi_type": kind,
        "location": {"x": point[0], "y": point[1], "z": 0.0},
        "orientation": {"pitch": 0.0, "yaw": 0.0, "roll": 0.0},
    }
    return {"id": name, "instance_name": instance, "properties": properties}


def _metres(cell: Cell) -> dict[str, float]:
    return {"x": float(cell[0] * BLOCK_M), "y": float(cell[1] * BLOCK_M)}
