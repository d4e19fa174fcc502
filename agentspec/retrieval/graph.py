"""A small undirected weighted graph, and the three algorithms that memories build on it.

Nodes are hashable and keep their order of insertion, which is also the order in which everything is visited: results
never depend on hashing. Label propagation is asynchronous and bounded: the synchronous form swaps labels for ever on
two nodes with an edge between them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterable, Iterator, Mapping
from typing import Any, Generic, TypeVar

N = TypeVar("N", bound=Hashable)


class Graph(Generic[N]):
    """Adjacency with weights. Self-loops are ignored; adding an edge again replaces its weight."""

    def __init__(self, edges: Iterable[tuple[N, N]] | Iterable[tuple[N, N, float]] = ()) -> None:
        self._adjacent: dict[N, dict[N, float]] = {}
        for edge in edges:
            self.connect(*edge)

    def __len__(self) -> int:
        return len(self._adjacent)

    def __iter__(self) -> Iterator[N]:
        return iter(self._adjacent)

    def __contains__(self, node: object) -> bool:
        return node in self._adjacent

    def add(self, node: N) -> None:
        """Add `node` without edges; one that is there stays as it is."""
        self._adjacent.setdefault(node, {})

    def connect(self, a: N, b: N, weight: float = 1.0) -> None:
        """Add both nodes and an edge between them."""
        self.add(a)
        self.add(b)
        if a != b:
            self._adjacent[a][b] = weight
            self._adjacent[b][a] = weight

    def remove(self, node: N) -> None:
        """Remove `node` and its edges; one that is not there is ignored."""
        for neighbour in self._adjacent.pop(node, {}):
            self._adjacent[neighbour].pop(node)

    def disconnect(self, a: N, b: N) -> None:
        """Remove the edge between two nodes; one that is not there is ignored."""
        if b in self._adjacent.get(a, {}):
            del self._adjacent[a][b], self._adjacent[b][a]

    def neighbours(self, node: N) -> Mapping[N, float]:
        """Neighbours of `node` with the weights of the edges."""
        return self._adjacent[node]

    def edges(self) -> Iterator[tuple[N, N, float]]:
        """Every edge once."""
        seen: set[N] = set()
        for node, neighbours in self._adjacent.items():
            seen.add(node)
            for other, weight in neighbours.items():
                if other not in seen:
                    yield node, other, weight

    def components(self, nodes: Iterable[N] | None = None) -> list[list[N]]:
        """Connected components of the graph, or of the subgraph that `nodes` induce; in order of their first node."""
        left = dict.fromkeys(self._adjacent if nodes is None else (n for n in nodes if n in self._adjacent))
        found: list[list[N]] = []
        while left:
            start = next(iter(left))
            del left[start]
            component, queue = [start], deque([start])
            while queue:
                for other in self._adjacent[queue.popleft()]:
                    if other in left:
                        del left[other]
                        component.append(other)
                        queue.append(other)
            found.append(component)
        return found

    def within(self, start: Iterable[N], hops: int) -> dict[N, int]:
        """Nodes at most `hops` edges away from any of `start`, with that distance; nearest first."""
        distance = {node: 0 for node in start if node in self._adjacent}
        queue = deque(distance)
        while queue:
            node = queue.popleft()
            if distance[node] == hops:
                continue
            for other in self._adjacent[node]:
                if other not in distance:
                    distance[other] = distance[node] + 1
                    queue.append(other)
        return distance

    def state(self) -> list[Any]:
        """JSON-like state (for JSON-like nodes): nodes, then per node its neighbours and weights, order included."""
        return [[node, [[other, weight] for other, weight in near.items()]] for node, near in self._adjacent.items()]

    def load(self, state: Iterable[Any]) -> None:
        """Return to `state`."""
        self._adjacent = {node: {other: weight for other, weight in near} for node, near in state}


def label_propagation(
    graph: Graph[N],
    *,
    start: Mapping[N, int] | None = None,
    changed: Iterable[N] | None = None,
    most_updates: int = 0,
) -> dict[N, int]:
    """Communities: every node takes the label with the greatest weight among its neighbours (Raghavan et al., 2007).

    Asynchronous, in order of insertion; a node keeps its label among the best ones, else takes the smallest of them. A
    change queues the neighbours; after `most_updates` visits (0: 20 per node) it stops where it is.

    Args:
        start: labels to begin from; nodes without one get a label of their own.
        changed: the nodes to begin with (default: all), for incremental use.
    """
    labels: dict[N, int] = {}
    fresh = max((start or {}).values(), default=-1) + 1
    for node in graph:
        if start is not None and node in start:
            labels[node] = start[node]
        else:
            labels[node], fresh = fresh, fresh + 1
    queue = deque(dict.fromkeys(graph if changed is None else (n for n in changed if n in graph)))
    queued = set(queue)
    for _ in range(most_updates or 20 * max(1, len(graph))):
        if not queue:
            break
        node = queue.popleft()
        queued.discard(node)
        weight: dict[int, float] = {}
        for other, w in graph.neighbours(node).items():
            weight[labels[other]] = weight.get(labels[other], 0.0) + w
        if not weight:
            continue
        most = max(weight.values())
        best = [label for label, w in weight.items() if w == most]
        if labels[node] in best:
            continue
        labels[node] = min(best)
        for other in graph.neighbours(node):
            if other not in queued:
                queued.add(other)
                queue.append(other)
    return labels


def ego_split(graph: Graph[N], nodes: Iterable[N] | None = None) -> dict[N, list[list[N]]]:
    """Per node its replicas: the components of its neighbours among themselves (Epasto et al., 2017).

    A node whose neighbours fall apart into several groups belongs to several communities. An isolated node has one
    replica without neighbours. `replica_graph` connects them.

    >>> bow_tie = Graph([("a", "b"), ("a", "c"), ("b", "c"), ("c", "d"), ("c", "e"), ("d", "e")])
    >>> ego_split(bow_tie)["c"]
    [['a', 'b'], ['d', 'e']]
    """
    return {node: graph.components(graph.neighbours(node)) or [[]] for node in (graph if nodes is None else nodes)}


def replica_graph(graph: Graph[N], replicas: Mapping[N, list[list[N]]]) -> Graph[tuple[N, int]]:
    """The graph of replicas (node, index): edge u-v connects u's replica that holds v with v's replica that holds u."""
    split: Graph[tuple[N, int]] = Graph()
    place = {(n, other): i for n, parts in replicas.items() for i, part in enumerate(parts) for other in part}
    for node, parts in replicas.items():
        for i in range(len(parts)):
            split.add((node, i))
    for a, b, weight in graph.edges():
        if (a, b) in place and (b, a) in place:
            split.connect((a, place[a, b]), (b, place[b, a]), weight)
    return split
