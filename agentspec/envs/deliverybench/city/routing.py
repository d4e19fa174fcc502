"""Ways through a city: snapping a point to a street, and shortest routes between any two points.

A route starts at an arbitrary point, goes straight to its foot on the nearest street, along the network to the foot of
the target, and straight to the target. Among equally short ways the reference's own search decides (see
`graph.shortest_paths`), but searching the whole network for every move would dominate the simulation. So the search
here expands only nodes that can lie on a shortest way, which the all-pairs table tells exactly: on a city without ties
it simply walks along the path.
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from agentspec.envs.deliverybench.city.geometry import Point, along, distance, length, rounded
from agentspec.envs.deliverybench.city.graph import NO_NODE, RELAX_TOLERANCE_CM, Graph, shortest_paths

if TYPE_CHECKING:
    from agentspec.envs.deliverybench.city.compile import Poi

__all__ = ["DistanceField", "Graph", "Network", "Router", "Snap", "SnapIndex", "Table"]

CELL_CM = 2500.0
FAR_CM = 1e8
MEMO_LIMIT = 65536
FIELD_LIMIT = 2048
# Two ways count as equally short when they differ by less than the rounding of coordinates can explain.
DETOUR_CM = 1e-3

Links = tuple[tuple[int, float], ...]
Route = tuple[Point, ...]


class Snap:
    """The nearest street point of some point: `foot` (cm), its street piece, and the ways from there to the nodes.

    `links` holds (node, length in cm): both ends of the street piece, or the one node the foot coincides with.
    """

    __slots__ = ("edge", "foot", "links")

    def __init__(self, foot: Point, edge: int, links: Links) -> None:
        self.foot = foot
        self.edge = edge
        self.links = links


class SnapIndex:
    """Finds the street piece nearest to a point: a grid of cells, each listing the pieces that can be nearest there."""

    def __init__(self, graph: Graph, kinds: frozenset[str] | None = None) -> None:
        self.graph = graph
        self._numbers = [i for i, e in enumerate(graph.edges) if kinds is None or e.kind in kinds]
        if not self._numbers:
            raise ValueError("the network has no street to snap to: give at least one road")
        ends = np.array([(*graph.points[graph.edges[i].u], *graph.points[graph.edges[i].v]) for i in self._numbers])
        self._start, self._span = ends[:, :2], ends[:, 2:] - ends[:, :2]
        self._span_sq = np.maximum((self._span**2).sum(axis=1), 1e-12)
        self._cells: dict[tuple[int, int], list[tuple[int, float, float, float, float, float]]] = {}
        self._memo: dict[Point, Snap] = {}

    def snap(self, p: Point) -> Snap:
        """The nearest street point of `p` by clamped distance; a tie within 1e-6 cm goes to the first street piece."""
        found = self._memo.get(p)
        if found is None:
            if len(self._memo) >= MEMO_LIMIT:
                self._memo.clear()
            found = self._memo[p] = self._snap(p)
        return found

    def _snap(self, p: Point) -> Snap:
        x, y = p
        if not (abs(x) <= FAR_CM and abs(y) <= FAR_CM):
            if math.isnan(x) or math.isnan(y):
                raise ValueError(f"cannot find a street near {p}: coordinates must be numbers")
            x, y = (min(max(c, -FAR_CM), FAR_CM) for c in p)
        key = (math.floor(x / CELL_CM), math.floor(y / CELL_CM))
        cell = self._cells.get(key)
        if cell is None:
            if len(self._cells) >= MEMO_LIMIT:
                self._cells.clear()
            cell = self._cells[key] = self._candidates(key)
        best, number, best_t = math.inf, NO_NODE, 0.0
        for candidate, ax, ay, dx, dy, span_sq in cell:
            px, py = x - ax, y - ay
            t = (px * dx + py * dy) / span_sq
            clamped = 0.0 if t < 0.0 else (1.0 if t > 1.0 else t)
            d = math.hypot(round(px - dx * clamped, 4), round(py - dy * clamped, 4))
            if d < best - RELAX_TOLERANCE_CM:
                best, number, best_t = d, candidate, clamped
        return self._at(number, best_t)

    def _at(self, number: int, t: float) -> Snap:
        graph = self.graph
        edge = graph.edges[number]
        a, b = graph.points[edge.u], graph.points[edge.v]
        foot = a if t <= 0.0 else (b if t >= 1.0 else along(a, b, t))
        node = graph.index.get(foot)
        if node is not None and node in (edge.u, edge.v):
            return Snap(foot, number, ((node, 0.0),))
        ends = ((edge.u, length(foot, a)), (edge.v, length(foot, b)))
        return Snap(foot, number, ends if node is None else ((node, 0.0), *ends))

    def _candidates(self, key: tuple[int, int]) -> list[tuple[int, float, float, float, float, float]]:
        # A piece farther from the cell's centre than the nearest one by more than the cell's diagonal is never nearest.
        center = np.array([(key[0] + 0.5) * CELL_CM, (key[1] + 0.5) * CELL_CM])
        offset = center - self._start
        t = np.clip((offset * self._span).sum(axis=1) / self._span_sq, 0.0, 1.0)
        gap = np.hypot(*(offset - t[:, None] * self._span).T)
        picked = np.flatnonzero(gap <= gap.min() + CELL_CM * math.sqrt(2.0) + 1.0)
        cell = []
        for i in picked:
            (ax, ay), (dx, dy) = self._start[i].tolist(), self._span[i].tolist()
            cell.append((self._numbers[i], ax, ay, dx, dy, float(self._span_sq[i])))
        return cell


Table = tuple[npt.NDArray[np.float64], npt.NDArray[np.int16]]


class Network:
    """A graph with its shortest paths and snap index: everything needed to route on it.

    Shortest paths come from `table` (distances and predecessors of all pairs, see `graph.all_pairs`) where one is
    given, and otherwise are searched per source node when first needed.
    """

    def __init__(self, graph: Graph, kinds: frozenset[str] | None = None, table: Table | None = None) -> None:
        self.graph = graph
        self.table = table
        self.snaps = SnapIndex(graph, kinds)
        self._to: dict[int, list[float]] = {}
        self._from: dict[int, tuple[list[float], list[int]]] = {}
        self._turned = graph.turned() if graph.one_way else graph
        self._near: dict[tuple[int, str, int], list[int]] = {}

    def to_node(self, node: int) -> list[float]:
        """Distance (cm) from every node to `node`."""
        row = self._to.get(node)
        if row is None:
            table = self.table
            row = shortest_paths(self._turned, node)[0] if table is None else table[0][:, node].tolist()
            self._to[node] = row
        return row

    def from_node(self, node: int) -> list[float]:
        """Distance (cm) from `node` to every node."""
        return self._tree(node)[0]

    def nearest_nodes(self, node: int, kind: str, count: int) -> list[int]:
        """The `count` nodes of a kind nearest to `node` by way (itself included), nearest first."""
        key = (node, kind, count)
        found = self._near.get(key)
        if found is None:
            row = self.from_node(node)
            members = (i for i, k in enumerate(self.graph.kinds) if k == kind)
            found = self._near[key] = heapq.nsmallest(count, members, key=lambda i: (row[i], i))
        return found

    def _tree(self, node: int) -> tuple[list[float], list[int]]:
        tree = self._from.get(node)
        if tree is None:
            table = self.table
            tree = (
                shortest_paths(self.graph, node)
                if table is None
                else (table[0][node].tolist(), table[1][node].tolist())
            )
            self._from[node] = tree
        return tree

    def path(self, source: int, target: int) -> Route:
        """Node positions of the shortest path between two nodes, both included; empty if there is none."""
        dist, before = self._tree(source)
        if not math.isfinite(dist[target]):
            return ()
        nodes = [target]
        while nodes[-1] != source:
            nodes.append(before[nodes[-1]])
        return tuple(self.graph.points[n] for n in reversed(nodes))

    def between(self, a: Snap, b: Snap) -> list[Point] | None:
        """Foot, nodes and foot of the shortest way between two street points; None if there is none."""
        if a.foot == b.foot:
            return [a.foot]
        rows = [(self.to_node(node), cost) for node, cost in b.links]
        best = min(out + row[u] + cost for u, out in a.links for row, cost in rows)
        if best == math.inf:
            return None
        if len(rows) > 2:
            rows = [([min(ways) for ways in zip(*([d + cost for d in row] for row, cost in rows), strict=True)], 0.0)]
        nodes = self._search(a.links, b, rows, best + DETOUR_CM)
        points = self.graph.points
        return [a.foot, *(points[n] for n in nodes), b.foot]

    def _search(self, start: Links, goal: Snap, rows: list[tuple[list[float], float]], limit: float) -> list[int]:
        """Nodes of the shortest way in order, settled as in `graph.shortest_paths`, ways longer than `limit` pruned."""
        points, arcs = self.graph.points, self.graph.arcs
        (row_a, cost_a), (row_b, cost_b) = rows[0], rows[-1]
        last = dict(goal.links)
        dist: dict[int, float] = {}
        before: dict[int, int] = {}
        heap: list[tuple[float, Point, int]] = []
        for u, d in start:
            if d + min(row_a[u] + cost_a, row_b[u] + cost_b) <= limit:
                dist[u] = d
                before[u] = NO_NODE
                heapq.heappush(heap, (d, points[u], u))
        reached, arrival = math.inf, NO_NODE
        while heap:
            d, point, u = heapq.heappop(heap)
            if d > dist[u]:
                continue
            if (d, point) > (reached, goal.foot):
                break
            step = last.get(u)
            if step is not None and d + step < reached - RELAX_TOLERANCE_CM:
                reached, arrival = d + step, u
            for v, cost in arcs[u]:
                candidate = d + cost
                known = dist.get(v)
                if known is not None:
                    if candidate >= known - RELAX_TOLERANCE_CM:
                        continue
                elif candidate + min(row_a[v] + cost_a, row_b[v] + cost_b) > limit:
                    continue
                dist[v] = candidate
                before[v] = u
                heapq.heappush(heap, (candidate, points[v], v))
        nodes = []
        while arrival != NO_NODE:
            nodes.append(arrival)
            arrival = before[arrival]
        nodes.reverse()
        return nodes


class DistanceField:
    """Path distances (cm) from one street point to every place: the shorter of the ways through its two neighbours.

    `memo` keeps what others derive from the field, such as descriptions of a place's surroundings.
    """

    __slots__ = ("_anchors", "_network", "_nodes", "_rows", "foot", "gap", "memo")

    def __init__(self, network: Network, p: Point, anchors: dict[str, int]) -> None:
        snap = network.snaps.snap(p)
        self.foot = snap.foot
        self.gap = distance(p, snap.foot)
        self._network = network
        self._nodes = [node for node, _ in snap.links]
        self._rows = [(network.from_node(node), cost) for node, cost in snap.links]
        self._anchors = anchors
        self.memo: dict[str, Any] = {}

    def to_node(self, node: int) -> float:
        """Distance (cm) from the foot to a node of the walk network."""
        best = math.inf
        for row, cost in self._rows:
            d = cost + row[node]
            if d < best:  # noqa: PLR1730 - a call of min() would double the cost of the commonest look-up
                best = d
        return best

    def to(self, poi: Poi) -> float:
        """Distance (cm) from the foot to a place's anchor; the straight gap from the point to its foot is not in it."""
        return self.to_node(self._anchors[poi.id])

    def nearest_nodes(self, kind: str, count: int) -> list[tuple[float, int]]:
        """The `count` nodes of a kind nearest to the foot, without the foot itself: (distance in cm, node)."""
        # Whatever is near through one neighbour is near that neighbour; one more, because the foot may be a node.
        near = {i for node in self._nodes for i in self._network.nearest_nodes(node, kind, count + 1)}
        found = sorted((self.to_node(i), i) for i in near)
        return [pair for pair in found if pair[0] > 0.0][:count]


class Router:
    """Routes on the walk and the drive network of one city, memoised."""

    def __init__(self, walk: Network, drive: Network, pois: tuple[Poi, ...]) -> None:
        self.walk = walk
        self.drive = drive
        self.anchors = {poi.id: walk.graph.index[poi.anchor] for poi in pois}
        self._walk_memo: dict[tuple[Point, Point], Route] = {}
        self._car_memo: dict[tuple[Point, Point], Route] = {}
        self._fields: dict[Point, DistanceField] = {}

    def walk_route(self, a: Point, b: Point) -> Route:
        """The polyline (cm) on pavements from `a` to `b`, both included; straight if no way exists."""
        key = (a, b)
        route = self._walk_memo.get(key)
        if route is None:
            if len(self._walk_memo) >= MEMO_LIMIT:
                self._walk_memo.clear()
            route = self._walk_memo[key] = _clean(self._walk(rounded(*a), rounded(*b)))
        return route

    def car_route(self, a: Point, b: Point) -> Route:
        """The polyline (cm) by car: pavement to the nearest lane, lanes, pavement to `b`; straight if no way exists."""
        key = (a, b)
        route = self._car_memo.get(key)
        if route is None:
            if len(self._car_memo) >= MEMO_LIMIT:
                self._car_memo.clear()
            route = self._car_memo[key] = _clean(self._car(rounded(*a), rounded(*b)))
        return route

    def field(self, p: Point) -> DistanceField:
        """Path distances from the street point nearest to `p`."""
        found = self._fields.get(p)
        if found is None:
            if len(self._fields) >= FIELD_LIMIT:
                self._fields.clear()
            found = self._fields[p] = DistanceField(self.walk, p, self.anchors)
        return found

    def _walk(self, a: Point, b: Point) -> list[Point]:
        snaps = self.walk.snaps
        way = self.walk.between(snaps.snap(a), snaps.snap(b))
        return [a, b] if way is None else [a, *way, b]

    def _car(self, a: Point, b: Point) -> list[Point]:
        snaps = self.drive.snaps
        start, goal = snaps.snap(a), snaps.snap(b)
        way = self.drive.between(start, goal)
        if way is None:
            return [a, b]
        return [*self._walk(a, start.foot), *way, *self._walk(goal.foot, b)]


def _clean(points: list[Point]) -> Route:
    """The polyline without consecutive duplicates."""
    kept = points[:1]
    for p in points[1:]:
        if p != kept[-1]:
            kept.append(p)
    return tuple(kept)
