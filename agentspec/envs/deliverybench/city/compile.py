"""From the two map files to street networks and places.

The walk network starts as four pavement corners per road, joined along the road (`road`), across its ends (`endcap`)
and between the corners of neighbouring roads (`crosswalk`). Long pieces are divided every 50 m. Then every place, in
file order, adds its dock and door; each one divides a pavement piece, so the next one meets a finer network. The drive
network has the same corners nearer to the road's centre, with one-way lanes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from agentspec.envs.deliverybench.city.geometry import (
    Point,
    along,
    box_exit,
    distance,
    orientation,
    project,
    quarter_turn,
    rounded,
    segment_distance,
)
from agentspec.envs.deliverybench.city.graph import Edge, Graph

SIDEWALK_OFFSET_CM = 1700.0
LANE_OFFSET_CM = 1000.0
WAYPOINT_SPACING_CM = 5000.0
MERGE_CM = 1.0
CROSSING_SLACK_CM = 100.0
BOX_MARGIN = 1.2
TIE_SQ = 1e-9

STREET_KINDS = frozenset({"road", "crosswalk", "endcap"})
BUILDING_KINDS = frozenset({"restaurant", "store", "rest_area", "hospital", "car_rental", "customer", "building"})
POINT_KINDS = frozenset({"charging_station", "bus_station"})
BUILDING_PREFIX = "BP_Building"


@dataclass(frozen=True, slots=True)
class Road:
    """One straight road segment (cm); `index` is 1-based file order and numbers its name ("3rd road")."""

    index: int
    name: str
    start: Point
    end: Point


@dataclass(frozen=True, slots=True)
class Poi:
    """A place: building, shop, charger or bus stop.

    Attributes:
        id: node id in the map file.
        kind: restaurant, store, rest_area, hospital, car_rental, customer, building, charging_station or bus_station.
        index: 1-based count within the kind, in file order.
        name: kind and index ("restaurant 2").
        center: own position (cm).
        anchor: where the courier is served (cm): the door, or the own position of a charger or bus stop.
        dock: where the way to the anchor leaves the pavement (cm).
        road: name of the pavement it stands at ("4th road (left)").
        yaw: orientation in degrees, 0 = +x, 90 = +y.
        bbox: extent (x, y) of the building in its own frame, without margin (cm); (0, 0) for chargers and stops.
        instance_name: asset name in the map file; that of every building begins with "BP_Building".
        json_index: position in the map file's node list.
    """

    id: str
    kind: str
    index: int
    name: str
    center: Point
    anchor: Point
    dock: Point
    road: str
    yaw: float
    bbox: Point
    instance_name: str
    json_index: int


def ordinal(n: int) -> str:
    """English ordinal numeral: 1st, 2nd, 3rd, 4th, 11th, 21st."""
    suffix = "th" if 10 <= n % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n}{suffix}"


def corners(road: Road, offset: float) -> tuple[Point, Point, Point, Point]:
    """The four corners of a road's strip `offset` cm beside and before its ends: left start, left end, right end, right
    start."""
    (ax, ay), (bx, by) = road.start, road.end
    length = distance(road.start, road.end)
    dx, dy = rounded((bx - ax) / length, (by - ay) / length)
    nx, ny = dy, -dx
    s = offset
    return (
        rounded(ax - s * nx + s * dx, ay - s * ny + s * dy),
        rounded(bx - s * nx - s * dx, by - s * ny - s * dy),
        rounded(bx + s * nx - s * dx, by + s * ny - s * dy),
        rounded(ax + s * nx + s * dx, ay + s * ny + s * dy),
    )


class NetworkBuilder:
    """A network that grows: nodes keyed by position, street pieces that can be divided."""

    def __init__(self) -> None:
        self.points: list[Point] = []
        self.kinds: list[str] = []
        self.names: list[str] = []
        self.index: dict[Point, int] = {}
        self.edges: dict[tuple[int, int], Edge] = {}

    def node(self, point: Point, kind: str, name: str = "") -> int:
        """The node at `point`, created if there is none."""
        found = self.index.get(point)
        if found is None:
            found = self.index[point] = len(self.points)
            self.points.append(point)
            self.kinds.append(kind)
            self.names.append(name)
        return found

    def corner(self, point: Point) -> int:
        """The node within 1 cm of `point`, or a new intersection."""
        found = self.index.get(point)
        if found is not None:
            return found
        for i, other in enumerate(self.points):
            if distance(point, other) <= MERGE_CM:
                return i
        return self.node(point, "intersection")

    def adjacent(self, u: int, v: int) -> bool:
        """Whether a piece joins u and v, in either direction."""
        return (u, v) in self.edges or (v, u) in self.edges

    def link(self, u: int, v: int, kind: str, name: str = "", one_way: bool = False) -> None:
        """Join two nodes; a piece that is already there keeps its kind."""
        if u != v and not self.adjacent(u, v):
            self.edges[(u, v)] = Edge(u, v, kind, name, one_way)

    def join_corners(self, reach: float, kind: str) -> None:
        """Link every two nodes within `reach` cm of each other that are not adjacent yet."""
        for u in range(len(self.points)):
            for v in range(u + 1, len(self.points)):
                if not self.adjacent(u, v) and distance(self.points[u], self.points[v]) <= reach:
                    self.link(u, v, kind)

    def divide(self, edge: Edge, node: int) -> None:
        """Replace a piece by two that meet at `node`, in the same direction; nothing if it is one of its ends."""
        if node in (edge.u, edge.v):
            return
        del self.edges[(edge.u, edge.v)]
        self.link(edge.u, node, edge.kind, edge.name, edge.one_way)
        self.link(node, edge.v, edge.kind, edge.name, edge.one_way)

    def add_waypoints(self) -> list[int]:
        """Divide every piece at 50 m, 100 m, ... from its first end, the last part being 50 to 100 m long."""
        added: list[int] = []
        for edge in list(self.edges.values()):
            a, b = self.points[edge.u], self.points[edge.v]
            length = distance(a, b)
            rest = edge
            for k in range(1, math.floor(length / WAYPOINT_SPACING_CM)):
                node = self.node(along(a, b, k * WAYPOINT_SPACING_CM / length), "normal")
                self.divide(rest, node)
                rest = self.edges[(node, edge.v)]
                added.append(node)
        return added

    def freeze(self) -> Graph:
        """The finished network."""
        return Graph.build(tuple(self.points), tuple(self.kinds), tuple(self.names), tuple(self.edges.values()))


class WalkCompiler:
    """Builds the walk network and the places of one city."""

    def __init__(self, roads: Sequence[Road]) -> None:
        self.net = NetworkBuilder()
        for road in roads:
            p1, p2, p3, p4 = (self.net.corner(p) for p in corners(road, SIDEWALK_OFFSET_CM))
            self.net.link(p1, p2, "road", f"{road.name} (left)")
            self.net.link(p3, p4, "road", f"{road.name} (right)")
            self.net.link(p1, p4, "endcap")
            self.net.link(p2, p3, "endcap")
        self.net.join_corners(2 * SIDEWALK_OFFSET_CM + CROSSING_SLACK_CM, "crosswalk")
        # The undivided pavements give every later node its street name.
        self.pavements = [
            (e.name, self.net.points[e.u], self.net.points[e.v]) for e in self.net.edges.values() if e.kind == "road"
        ]
        for node in self.net.add_waypoints():
            self.net.names[node] = self.road_name(self.net.points[node], None)
        self.counts: dict[str, int] = {}

    def road_name(self, p: Point, group: str | None) -> str:
        """Name of the nearest pavement, of one orientation if `group` is 'h' or 'v' and there is one.

        A bus stop diagonally off a corner is equally near to two pavements; the earlier road then names it.
        """
        if not self.pavements:
            return ""
        pool = [s for s in self.pavements if group is None or orientation(s[1], s[2]) == group] or self.pavements
        best, name = math.inf, ""
        for candidate, a, b in pool:
            d = segment_distance(p, a, b)
            if d < best - TIE_SQ:
                best, name = d, candidate
        return name

    def dock(self, p: Point, group: str | None, name: str) -> int:
        """The pavement node a place at `p` is reached from, dividing or prolonging the street it lies on."""
        pool = [e for e in self.net.edges.values() if e.kind in STREET_KINDS]
        if group is not None:
            points = self.net.points
            pool = [e for e in pool if orientation(points[e.u], points[e.v]) == group] or pool
        edge, foot = self._best_street(p, pool)
        node = self.net.node(foot.line, "normal", name)
        if 0.0 <= foot.t <= 1.0:
            self.net.divide(edge, node)
        else:
            end = edge.u if foot.t < 0.0 else edge.v
            self.net.link(end, node, "aux_ext")
        return node

    def _best_street(self, p: Point, pool: Iterable[Edge]) -> Any:
        # The infinite line decides and the segment only breaks ties, so a place may dock beyond the end of its street.
        best = None
        line_sq = segment_sq = math.inf
        for edge in pool:
            foot = project(p, self.net.points[edge.u], self.net.points[edge.v])
            if foot.line_sq > line_sq + TIE_SQ:
                continue
            if foot.line_sq < line_sq - TIE_SQ or foot.segment_sq < segment_sq - TIE_SQ:
                best, line_sq, segment_sq = (edge, foot), foot.line_sq, foot.segment_sq
        return best

    def place(self, node: Mapping[str, Any], json_index: int) -> Poi | None:
        """Add one node of the map file to the network; None if it is not a place (a road tile, say)."""
        kind = place_kind(node)
        if kind is None:
            return None
        properties = node["properties"]
        center = rounded(float(properties["location"]["x"]), float(properties["location"]["y"]))
        yaw = float((properties.get("orientation") or {}).get("yaw", 0.0))
        box = properties.get("bbox") or {}
        bbox = (float(box.get("x", 0.0)), float(box.get("y", 0.0)))
        self.counts[kind] = index = self.counts.get(kind, 0) + 1
        if kind in BUILDING_KINDS:
            turn = quarter_turn(yaw)
            group = "h" if turn in (0, 180) else "v"
            anchor = box_exit(center, BOX_MARGIN * bbox[0], BOX_MARGIN * bbox[1], yaw, turn + 90.0)
            road = self.road_name(anchor, group)
            anchor_kind = "door"
        else:
            group, anchor, anchor_kind = None, center, kind
            road = self.road_name(anchor, None)
        dock = self.dock(anchor, group, road)
        self.net.link(dock, self.net.node(anchor, anchor_kind, road), "aux_perp")
        return Poi(
            str(node["id"]), kind, index, f"{kind} {index}", center, anchor, self.net.points[dock], road, yaw, bbox,
            str(node.get("instance_name", "")), json_index,
        )  # fmt: skip


def place_kind(node: Mapping[str, Any]) -> str | None:
    """The kind of place a map node is, None for scenery."""
    properties = node.get("properties") or {}
    kind = str(properties.get("poi_type") or properties.get("type") or "").lower()
    if kind in BUILDING_KINDS or kind in POINT_KINDS:
        return kind
    return "building" if str(node.get("instance_name", "")).startswith(BUILDING_PREFIX) else None


def compile_walk(roads: Sequence[Road], nodes: Sequence[Mapping[str, Any]]) -> tuple[Graph, tuple[Poi, ...]]:
    """The walk network and all places of a city, in file order."""
    compiler = WalkCompiler(roads)
    places = [compiler.place(node, i) for i, node in enumerate(nodes)]
    return compiler.net.freeze(), tuple(poi for poi in places if poi is not None)


def compile_drive(roads: Sequence[Road]) -> Graph:
    """The drive network: one-way lanes, two-way connectors at the ends of roads and between neighbouring roads."""
    net = NetworkBuilder()
    for road in roads:
        d1, d2, d3, d4 = (net.corner(p) for p in corners(road, LANE_OFFSET_CM))
        net.link(d1, d2, "lane", road.name, one_way=True)
        net.link(d3, d4, "lane", road.name, one_way=True)
        net.link(d1, d4, "connector", road.name)
        net.link(d2, d3, "connector", road.name)
    net.join_corners(2 * LANE_OFFSET_CM + CROSSING_SLACK_CM, "connector")
    net.add_waypoints()
    return net.freeze()
