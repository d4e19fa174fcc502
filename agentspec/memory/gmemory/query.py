"""The query graph of G-Memory: a node per episode (its task and how it began), joined to those that are like it."""

from __future__ import annotations

from agentspec.memory.parts.entries import Entries, Entry
from agentspec.retrieval import Graph

NEAREST = 10
"""Nearest episodes that are looked at: to be joined, and to be shown."""


class QueryGraph:
    """Episodes and the edges between them.

    Args:
        episodes: what each was, found by meaning.
        edge: least cosine of episodes that are joined.
        hops: how far related episodes are looked for.
    """

    def __init__(self, episodes: Entries, edge: float, hops: int) -> None:
        self.episodes, self.edge, self.hops = episodes, edge, hops
        self.graph: Graph[int] = Graph()

    def keep(self, episode: Entry) -> None:
        """Add an episode; what had to be forgotten for it leaves the graph, too."""
        near = self.episodes.near(episode.text, NEAREST, least=self.edge)
        self.episodes.put(episode)
        self.graph.add(episode.id)
        for other, score in near:
            self.graph.connect(episode.id, other.id, round(score, 6))
        for id in [id for id in self.graph if id not in self.episodes]:
            self.graph.remove(id)

    def related(self, near: list[tuple[Entry, float]]) -> list[int]:
        """Of episodes with their similarity to a task those that are joined to it, and their neighbours."""
        return list(self.graph.within([e.id for e, score in near if score >= self.edge], self.hops))
