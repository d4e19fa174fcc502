"""One level of CAM's hierarchy: a graph whose nodes may belong to several clusters, kept up to date as it grows.

Every node is split into replicas, one per group of its neighbours that hang together without it (ego-splitting); labels
spread over the graph of replicas, and replicas of one label are a cluster. It hangs together: where a label has come to
stand at places with no way between them, all but the largest part get a new one. When nodes or edges change, only the
nodes they touch are split anew, and labels spread from their replicas: a replica keeps the label of the one it comes
from (the one of the same node with most neighbours in common), a new one gets a label that was never there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from agentspec.retrieval import Graph, ego_split, label_propagation, replica_graph


def affinity(cosine: float, apart: float, alpha: float = 0.6, sigma: float = 1.0) -> float:
    """How strongly two chunks belong together: likeness in meaning and nearness in order.

    >>> round(affinity(0.5, 1), 4)
    0.5426
    """
    return alpha * cosine + (1 - alpha) * math.exp(-(apart**2) / (2 * sigma**2))


class Level:
    """A graph of nodes, their replicas, and the label of each."""

    def __init__(self) -> None:
        self.graph: Graph[int] = Graph()
        self.replicas: dict[int, list[list[int]]] = {}
        self.labels: dict[tuple[int, int], int] = {}
        self.fresh = 0  # the next label that was never there

    def touch(self, nodes: Iterable[int]) -> None:
        """Bring replicas and labels up to date after these nodes came, went, or got or lost edges."""
        nodes = list(nodes)
        around = [n for node in nodes if node in self.graph for n in (node, *self.graph.neighbours(node))]
        affected = dict.fromkeys(around)
        before = {
            node: [(set(part), self.labels[node, i]) for i, part in enumerate(self.replicas[node])]
            for node in affected
            if node in self.replicas
        }
        touched = {label for parts in before.values() for _, label in parts}
        anew = ego_split(self.graph, affected)
        self.replicas = {node: anew.get(node) or self.replicas[node] for node in self.graph}
        labels: dict[tuple[int, int], int] = {}
        for node, parts in self.replicas.items():
            if node not in affected:
                labels |= {(node, i): self.labels[node, i] for i in range(len(parts))}
                continue
            for i, part in enumerate(parts):
                labels[node, i] = self._inherited(set(part), before.get(node, []))
        changed = [(node, i) for node in affected for i in range(len(self.replicas[node]))]
        split = replica_graph(self.graph, self.replicas)
        self.labels = label_propagation(split, start=labels, changed=changed)
        touched |= {label for replica, label in labels.items() if self.labels[replica] != label}
        self._part(split, touched | {self.labels[replica] for replica in changed})

    def _part(self, split: Graph[tuple[int, int]], touched: set[int]) -> None:
        """A fresh label for each part of a cluster that is not connected with its largest one (of equals the first).

        Args:
            touched: labels that have lost or got replicas, or whose replicas have got other neighbours.
        """
        members: dict[int, list[tuple[int, int]]] = {}
        for replica, label in self.labels.items():
            if label in touched:
                members.setdefault(label, []).append(replica)
        for replicas in members.values():
            parts = split.components(replicas) if len(replicas) > 1 else []
            for part in sorted(parts, key=lambda p: -len(p))[1:]:
                self.labels |= dict.fromkeys(part, self.fresh)
                self.fresh += 1

    def _inherited(self, part: set[int], old: list[tuple[set[int], int]]) -> int:
        """The label of the old replica with most neighbours in common (then taken), or a fresh one."""
        best = max(old, key=lambda o: len(o[0] & part), default=None)
        if best is not None and (best[0] & part or not best[0]):
            old.remove(best)
            return best[1]
        self.fresh += 1
        return self.fresh - 1

    def clusters(self, least: int = 2) -> dict[int, list[int]]:
        """Label -> its nodes, in order of insertion; those of at least `least` nodes."""
        found: dict[int, dict[int, None]] = {}
        for (node, _), label in self.labels.items():
            found.setdefault(label, {})[node] = None
        return {label: list(nodes) for label, nodes in found.items() if len(nodes) >= least}

    def state(self) -> list[Any]:
        """JSON-like state: the graph, and per node the labels of its replicas; these follow from the graph."""
        return [self.graph.state(), list(self.labels.values()), self.fresh]

    def load(self, state: list[Any]) -> None:
        """Return to `state`."""
        graph, labels, self.fresh = state
        self.graph.load(graph)
        self.replicas = ego_split(self.graph)
        places = [(node, i) for node, parts in self.replicas.items() for i in range(len(parts))]
        self.labels = dict(zip(places, labels, strict=True))
