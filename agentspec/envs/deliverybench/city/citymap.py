"""The city: places of interest, streets, the bus route, and the two networks a courier can move on.

A city is described by two files. `roads.json` lists straight road segments (metres); `progen_world_enriched.json`
lists buildings, chargers and bus stops (centimetres) and one bus route (metres). `load_city` compiles them into a
`City`: an immutable object that any number of simulated worlds share. Everything inside is in **centimetres**, x to
the right and y up, with every coordinate rounded to four decimals, because ties between equally good streets are
decided by exactly that rounding.

The walk network runs along the pavements (both sides of a road, joined by crosswalks), the drive network along the
lanes (one-way). Every place owns a *dock*, its foot on the pavement, and an *anchor*, the point where a courier is
served: the door of a building, the place itself for a charger or a bus stop.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from agentspec.envs.deliverybench.city.cache import Compiled, content_key, read_compiled, write_compiled
from agentspec.envs.deliverybench.city.compile import STREET_KINDS, Poi, Road, compile_drive, compile_walk, ordinal
from agentspec.envs.deliverybench.city.geometry import Point, rounded
from agentspec.envs.deliverybench.city.graph import Graph, all_pairs
from agentspec.envs.deliverybench.city.routing import DistanceField, Network, Router

__all__ = ["BusRoute", "City", "MapError", "Poi", "Point", "Road", "build_city", "forget_cities", "load_city"]

ROADS_FILE = "roads.json"
WORLD_FILE = "progen_world_enriched.json"
CM_PER_M = 100.0
MEMORY_LIMIT = 32
_CELL_CM = 1000.0

_memory: dict[tuple[str, str], City] = {}
_lock = threading.Lock()


class MapError(ValueError):
    """A map folder that is missing, incomplete or malformed."""


@dataclass(frozen=True, slots=True)
class BusRoute:
    """The bus line. A city without one has an empty route.

    Attributes:
        id: route id ("route_bus_1").
        stop_names: "bus_station k" in service order, also the ids a courier uses; k comes from the station's id.
        stops: stop positions in service order (cm), unrounded as in the file.
        path: corner points of the line (cm), without the stops.
    """

    id: str
    stop_names: tuple[str, ...]
    stops: tuple[Point, ...]
    path: tuple[Point, ...]

    @property
    def points(self) -> tuple[Point, ...]:
        """Path and stops interleaved: path[0], stop[0], path[1], stop[1], ... then the rest of the path."""
        mixed: list[Point] = []
        for i, point in enumerate(self.path):
            mixed.extend((point, self.stops[i]) if i < len(self.stops) else (point,))
        mixed.extend(self.stops[len(self.path) :])
        return tuple(mixed)


class City:
    """A compiled city: immutable, shared by many worlds. Built by `load_city`, `build_city` or `generate`.

    Attributes:
        name: name of the map folder.
        pois: all places in file order.
        roads: all road segments in file order.
        bus: the bus line.
        router: routes on both networks.
    """

    def __init__(
        self,
        *,
        name: str,
        pois: tuple[Poi, ...],
        roads: tuple[Road, ...],
        bus: BusRoute,
        walk: Network,
        drive: Network,
    ) -> None:
        self.name = name
        self.pois = pois
        self.roads = roads
        self.bus = bus
        self.router = Router(walk, drive, pois)
        kinds: dict[str, list[Poi]] = {}
        for poi in pois:
            kinds.setdefault(poi.kind, []).append(poi)
        self._by_kind = {kind: tuple(members) for kind, members in kinds.items()}
        self._by_key = {poi.name: poi for poi in reversed(pois)} | {poi.id: poi for poi in reversed(pois)}

    def __repr__(self) -> str:
        return f"City({self.name!r}, {len(self.roads)} roads, {len(self.pois)} places)"

    def __deepcopy__(self, memo: object) -> City:
        """Itself: a city never changes, and copies of a world share it."""
        return self

    # -- places ------------------------------------------------------------------------------------------------

    def poi(self, key: str) -> Poi:
        """A place by id or display name ("restaurant 2")."""
        try:
            return self._by_key[key]
        except KeyError:
            raise KeyError(f"{self.name} has no place {key!r}: give an id or a name such as 'restaurant 1'") from None

    def pois_of(self, kind: str) -> tuple[Poi, ...]:
        """All places of a kind in file order; empty when the city has none."""
        return self._by_kind.get(kind, ())

    def nearest(self, kind: str, p: Point) -> tuple[Poi, float] | None:
        """The place of `kind` whose anchor is nearest to `p` in a straight line, with that distance (cm)."""
        best: Poi | None = None
        gap = math.inf
        x, y = p
        for poi in self._by_kind.get(kind, ()):
            d = math.hypot(poi.anchor[0] - x, poi.anchor[1] - y)
            if d < gap:
                best, gap = poi, d
        return None if best is None else (best, gap)

    def near(self, kind: str, p: Point, tolerance_cm: float = 500.0) -> Poi | None:
        """The nearest place of `kind` if its anchor is within `tolerance_cm` of `p`, else None."""
        found = self.nearest(kind, p)
        return found[0] if found is not None and found[1] <= tolerance_cm else None

    def pois_near(self, p: Point, tolerance_cm: float = 500.0) -> list[Poi]:
        """All places whose anchor is within `tolerance_cm` of `p`, nearest first (plain buildings included)."""
        reach = math.ceil(tolerance_cm / _CELL_CM)
        column, row = math.floor(p[0] / _CELL_CM), math.floor(p[1] / _CELL_CM)
        found = [
            (gap, poi)
            for dx in range(-reach, reach + 1)
            for dy in range(-reach, reach + 1)
            for poi in self._anchor_cells.get((column + dx, row + dy), ())
            if (gap := math.dist(p, poi.anchor)) <= tolerance_cm
        ]
        found.sort(key=lambda pair: pair[0])
        return [poi for _, poi in found]

    @cached_property
    def _anchor_cells(self) -> dict[tuple[int, int], list[Poi]]:
        cells: dict[tuple[int, int], list[Poi]] = {}
        for poi in self.pois:
            x, y = poi.anchor
            cells.setdefault((math.floor(x / _CELL_CM), math.floor(y / _CELL_CM)), []).append(poi)
        return cells

    # -- networks ----------------------------------------------------------------------------------------------

    @property
    def walk(self) -> Graph:
        """The pavement network."""
        return self.router.walk.graph

    @property
    def drive(self) -> Graph:
        """The lane network (one-way edges)."""
        return self.router.drive.graph

    def walk_route(self, a: Point, b: Point) -> tuple[Point, ...]:
        """The polyline (cm) of a courier on foot, on a scooter or dragging it, from `a` to `b`, both included."""
        return self.router.walk_route(a, b)

    def car_route(self, a: Point, b: Point) -> tuple[Point, ...]:
        """The polyline (cm) of a car from `a` to `b`: to the nearest lane, along lanes, and from the lane to `b`."""
        return self.router.car_route(a, b)

    def door_distance(self, a: Poi, b: Poi) -> float:
        """Shortest path (cm) from the anchor of `a` to that of `b`; `inf` when they are not connected."""
        anchors = self.router.anchors
        return self.router.walk.from_node(anchors[a.id])[anchors[b.id]]

    def distances_from(self, p: Point) -> DistanceField:
        """Path distances (cm) from the pavement point nearest to `p`; `.to(poi)` looks one up."""
        return self.router.field(p)

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """(min x, min y, max x, max y) of roads and places (cm)."""
        points = [p for road in self.roads for p in (road.start, road.end)]
        for poi in self.pois:
            points.extend((poi.anchor, poi.center))
        xs, ys = zip(*points, strict=True)
        return (min(xs), min(ys), max(xs), max(ys))


def build_city(name: str, roads_document: Mapping[str, Any], world_document: Mapping[str, Any]) -> City:
    """Compile a city from the contents of its two files, without the disk cache; paths are searched when needed."""
    roads = _roads(roads_document)
    return _city(name, roads, world_document, _compile(roads, world_document))


def load_city(path: str | Path) -> City:
    """The city in the folder `path`: from memory, from the disk cache, or compiled (about a second) and cached.

    Raises:
        MapError: the folder or one of its two files is missing or malformed.
    """
    folder = Path(path)
    documents = [_read(folder, ROADS_FILE), _read(folder, WORLD_FILE)]
    key = (folder.resolve().name, content_key(documents))
    with _lock:
        city = _memory.get(key)
        if city is None:
            while len(_memory) >= MEMORY_LIMIT:
                _memory.pop(next(iter(_memory)))
            city = _memory[key] = _load(folder, documents, *key)
        return city


def forget_cities() -> None:
    """Drop all loaded cities from memory, with the ways found in them; the next `load_city` reads the disk cache."""
    with _lock:
        _memory.clear()


def _load(folder: Path, documents: list[bytes], name: str, key: str) -> City:
    parsed = []
    for file, document in zip((ROADS_FILE, WORLD_FILE), documents, strict=True):
        try:
            parsed.append(json.loads(document))
        except ValueError as error:
            raise MapError(f"{folder / file} is not JSON ({error}): copy the map file again") from error
    roads_document, world_document = parsed
    try:
        roads = _roads(roads_document)
        compiled = read_compiled(key)
        if compiled is None:
            compiled = _with_tables(_compile(roads, world_document))
            write_compiled(key, compiled)
        return _city(name, roads, world_document, compiled)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise MapError(
            f"the map in {folder} lacks a field or has it in another shape ({type(error).__name__}: {error}); expected "
            f"'roads' with start and end in {ROADS_FILE}, and 'nodes' and 'bus_routes' in {WORLD_FILE}"
        ) from error


def _read(folder: Path, file: str) -> bytes:
    remedy = f"give a folder that holds {ROADS_FILE} and {WORLD_FILE}, or make one with generate.write_city"
    if not folder.is_dir():
        raise MapError(f"no map folder {folder} (needed: {file}): {remedy}")
    try:
        return (folder / file).read_bytes()
    except OSError as error:
        raise MapError(f"the map folder {folder} has no readable {file} ({error.strerror}): {remedy}") from error


def _compile(roads: tuple[Road, ...], world: Mapping[str, Any]) -> Compiled:
    graph, pois = compile_walk(roads, world["nodes"])
    return pois, Network(graph, STREET_KINDS), Network(compile_drive(roads))


def _with_tables(compiled: Compiled) -> Compiled:
    pois, walk, drive = compiled
    walk, drive = (
        Network(walk.graph, STREET_KINDS, all_pairs(walk.graph)),
        Network(drive.graph, None, all_pairs(drive.graph)),
    )
    return pois, walk, drive


def _city(
    name: str,
    roads: tuple[Road, ...],
    world: Mapping[str, Any],
    compiled: Compiled,
) -> City:
    pois, walk, drive = compiled
    return City(name=name, pois=pois, roads=roads, bus=_bus(world), walk=walk, drive=drive)


def _roads(document: Mapping[str, Any]) -> tuple[Road, ...]:
    roads = []
    for i, road in enumerate(document["roads"], start=1):
        start, end = (_metres(road[side]) for side in ("start", "end"))
        if start == end:
            raise MapError(f"road {i} of {ROADS_FILE} starts and ends at {start}: give two different points")
        roads.append(Road(i, f"{ordinal(i)} road", start, end))
    if not roads:
        raise MapError(f"{ROADS_FILE} lists no roads: a city needs at least one")
    return tuple(roads)


def _bus(world: Mapping[str, Any]) -> BusRoute:
    routes = world.get("bus_routes") or []
    if not routes:
        return BusRoute("", (), (), ())
    positions = {node["id"]: node["properties"]["location"] for node in world["nodes"]}
    names, stops = [], []
    for station in routes[0]["station_ids"]:
        names.append(f"bus_station {int(station.split('_')[3]) + 1}")
        stops.append((float(positions[station]["x"]), float(positions[station]["y"])))
    path = tuple(_metres(p) for p in routes[0]["path"])
    return BusRoute(str(routes[0]["id"]), tuple(names), tuple(stops), path)


def _metres(point: Mapping[str, Any]) -> Point:
    return rounded(float(point["x"]) * CM_PER_M, float(point["y"]) * CM_PER_M)
