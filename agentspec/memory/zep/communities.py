"""Communities of a graph's entities, and a summary of each: found by label propagation, from the labels there are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from agentspec.retrieval import Graph, label_propagation
from agentspec.state import Json


class Communities:
    """Which entities belong together, and what was summed up of whom."""

    def __init__(self) -> None:
        self._labels: dict[int, int] = {}  # entity -> community
        self._summaries: dict[int, tuple[list[int], str]] = {}  # community -> members when it was summed up, summary
        self._written: Json | None = None

    def __len__(self) -> int:
        return len(self._summaries)

    def renew(self, graph: Graph[int]) -> list[tuple[int, list[int]]]:
        """Find communities anew; those of at least two whose members have changed since their summary, largest first.

        Summaries of communities that are no more are forgotten.
        """
        known = {id: label for id, label in self._labels.items() if id in graph}
        new = [id for id in graph if id not in known]
        self._labels, self._written = label_propagation(graph, start=known, changed=new or None), None
        members: dict[int, list[int]] = {}
        for id, label in self._labels.items():
            members.setdefault(label, []).append(id)
        self._summaries = {label: kept for label, kept in self._summaries.items() if label in members}
        changed = [m for m in members.items() if len(m[1]) > 1 and self._summaries.get(m[0], ([], ""))[0] != m[1]]
        return sorted(changed, key=lambda m: -len(m[1]))

    def sum_up(self, community: int, members: list[int], summary: str) -> None:
        """Keep a summary of a community as it is now."""
        self._summaries[community], self._written = (members, summary), None

    def summary_for(self, entities: Iterable[int]) -> str:
        """The summary of the community that most of these belong to; empty if there is none."""
        votes: dict[int, int] = {}
        for entity in entities:
            label = self._labels.get(entity, -1)
            votes[label] = votes.get(label, 0) + (label in self._summaries)
        best = max(votes, key=lambda label: votes[label], default=-1)
        return self._summaries[best][1] if best in self._summaries else ""

    def state(self) -> Json:
        """State as JSON; written once per change."""
        if self._written is None:
            summaries = [[label, ids, text] for label, (ids, text) in self._summaries.items()]
            self._written = Json.of([list(self._labels.items()), summaries])
        return self._written

    def load(self, state: Sequence[Any]) -> None:
        """Return to `state`."""
        labels, summaries = state
        self._labels, self._written = {id: label for id, label in labels}, None
        self._summaries = {label: (ids, text) for label, ids, text in summaries}
