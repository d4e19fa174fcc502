"""A street network as a graph of points, and its all-pairs shortest paths.

A node *is* its position: two nodes at the same (rounded) point are one. Shortest paths follow the reference's own
rule to the letter, since a grid of equal blocks has many equally short ways and the choice among them must be
repeatable: nodes are settled by (distance, x, y), and a shorter way replaces a known one only if it gains more than
`RELAX_TOLERANCE_CM`.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from agentspec.envs.deliverybench.city.geometry import Point, length

RELAX_TOLERANCE_CM = 1e-6
NO_NODE = -1

Arcs = tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True)
class Edge:
    """One street piece between nodes `u` and `v`; `one_way` allows travel from `u` to `v` only."""

    u: int
    v: int
    kind: str
    name: str
    one_way: bool = False


@dataclass(frozen=True)
class Graph:
    """An immutable network.

    Attributes:
        points: node positions (cm), one per node.
        kinds: node kinds (intersection, normal, door, charging_station, bus_station).
        names: street name of each node, "" where there is none.
        edges: undirected or one-way street pieces.
        arcs: for every node the (neighbour, length in cm) pairs one can travel to.
        index: node number by position.
    """

    points: tuple[Point, ...]
    kinds: tuple[str, ...]
    names: tuple[str, ...]
    edges: tuple[Edge, ...]
    arcs: tuple[Arcs, ...] = field(repr=False)
    index: dict[Point, int] = field(repr=False)

    @classmethod
    def build(
        cls, points: tuple[Point, ...], kinds: tuple[str, ...], names: tuple[str, ...], edges: tuple[Edge, ...]
    ) -> Graph:
        """A graph from nodes and edges; lengths and adjacency are derived."""
        arcs: list[list[tuple[int, float]]] = [[] for _ in points]
        for edge in edges:
            cost = length(points[edge.u], points[edge.v])
            arcs[edge.u].append((edge.v, cost))
            if not edge.one_way:
                arcs[edge.v].append((edge.u, cost))
        frozen = tuple(tuple(out) for out in arcs)
        return cls(points, kinds, names, edges, frozen, {p: i for i, p in enumerate(points)})

    def __len__(self) -> int:
        return len(self.points)

    @property
    def one_way(self) -> bool:
        """Whether any street piece can be travelled in one direction only."""
        return any(edge.one_way for edge in self.edges)

    def turned(self) -> Graph:
        """The same network with every one-way piece turned round."""
        edges = tuple(Edge(e.v, e.u, e.kind, e.name, True) if e.one_way else e for e in self.edges)
        return Graph.build(self.points, self.kinds, self.names, edges)


def shortest_paths(graph: Graph, source: int) -> tuple[list[float], list[int]]:
    """Distance (cm, `inf` if unreachable) and predecessor (`NO_NODE` at the source) of every node."""
    points, arcs = graph.points, graph.arcs
    dist = [math.inf] * len(points)
    before = [NO_NODE] * len(points)
    dist[source] = 0.0
    heap = [(0.0, points[source], source)]
    while heap:
        d, _, u = heapq.heappop(heap)
        if d > dist[u]:
            continue
        for v, cost in arcs[u]:
            candidate = d + cost
            if candidate < dist[v] - RELAX_TOLERANCE_CM:
                dist[v] = candidate
                before[v] = u
                heapq.heappush(heap, (candidate, points[v], v))
    return dist, before


def all_pairs(graph: Graph) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int16]]:
    """Distances (n, n) in cm and predecessors (n, n): `[s, t]` is the way from s to t, and the node before t on it."""
    size = len(graph)
    if size > np.iinfo(np.int16).max:
        raise ValueError(f"got a network of {size} nodes; the table numbers at most {np.iinfo(np.int16).max}")
    dist = np.empty((size, size), dtype=np.float64)
    before = np.empty((size, size), dtype=np.int16)
    for source in range(size):
        dist[source], before[source] = shortest_paths(graph, source)
    return dist, before
