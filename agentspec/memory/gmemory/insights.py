"""The insights of G-Memory: rules with a score and the tasks that support them, changed by operations; and clusters.

A rule begins with score 2; agreeing with it or editing it adds 1; removing it takes 1 away (3 once there are ten rules
or more). A rule that was shown for a task gains 1 if the task succeeded and loses 2 if it failed. Rules at 0 go.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agentspec.retrieval import Graph

ADDED, AGREED, REMOVED, REMOVED_OF_MANY, MANY = 2, 1, -1, -3, 10
SUCCEEDED, FAILED = 1, -2
OPERATIONS = ("ADD", "EDIT", "AGREE", "REMOVE")


@dataclass(frozen=True)
class Insight:
    """A rule, its score, and the tasks it comes from."""

    id: int
    text: str
    score: int = ADDED
    tasks: tuple[int, ...] = ()


@dataclass(frozen=True)
class Change:
    """What the model wants done with the rules; `rule` is a number as the prompt showed it, from 1."""

    op: str
    rule: int | None = None
    text: str | None = ""

    def __post_init__(self) -> None:
        if self.op.strip().upper() not in OPERATIONS:
            raise ValueError(f"'op' must be one of {', '.join(OPERATIONS)}, not {self.op[:20]!r}")


class Insights:
    """Rules in the order in which they were found.

    Args:
        capacity: most rules; beyond, the one with the lowest score goes, of equals the oldest.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._rules: dict[int, Insight] = {}

    def __len__(self) -> int:
        return len(self._rules)

    def __iter__(self) -> Iterator[Insight]:
        return iter(self._rules.values())

    def __contains__(self, id: int) -> bool:
        return id in self._rules

    def __getitem__(self, id: int) -> Insight:
        return self._rules[id]

    def put(self, insight: Insight) -> None:
        """Add a rule, or replace the one with its id; one whose score is 0 or less goes."""
        self._rules[insight.id] = insight
        if insight.score <= 0:
            del self._rules[insight.id]
        while len(self._rules) > self.capacity:
            worst = min(self._rules.values(), key=lambda rule: rule.score)
            del self._rules[worst.id]

    def remove(self, id: int) -> None:
        """Forget a rule; one that is not there is ignored."""
        self._rules.pop(id, None)

    def change(self, change: Change, shown: Sequence[int], tasks: Iterable[int], new_id: int) -> bool:
        """Do one operation; `False` if it names no rule that was shown, or says nothing.

        Args:
            shown: ids of the rules in the order in which they were numbered.
            tasks: the tasks that the operation comes from.
            new_id: id of a rule that is added.
        """
        op, text = change.op.strip().upper(), " ".join((change.text or "").split())
        if op == "ADD":
            if text and all(rule.text != text for rule in self):
                self.put(Insight(new_id, text, tasks=tuple(dict.fromkeys(tasks))))
            return bool(text)
        number = change.rule
        id = shown[number - 1] if number is not None and 1 <= number <= len(shown) else -1
        if id not in self or (op == "EDIT" and not text):
            return False
        rule = self[id]
        if op == "REMOVE":
            self.put(replace(rule, score=rule.score + (REMOVED_OF_MANY if len(self) >= MANY else REMOVED)))
            return True
        supported = tuple(dict.fromkeys((*rule.tasks, *tasks)))
        self.put(replace(rule, text=text if op == "EDIT" else rule.text, score=rule.score + AGREED, tasks=supported))
        return True

    def judge(self, shown: Iterable[int], success: bool) -> None:
        """A task for which these rules were shown has ended."""
        for id in shown:
            if id in self:
                self.put(replace(self[id], score=self[id].score + (SUCCEEDED if success else FAILED)))

    def for_tasks(self, tasks: Iterable[int], k: int) -> list[Insight]:
        """The rules that most of these tasks support, of equals those with the higher score."""
        wanted = set(tasks)
        support = [(len(wanted & set(rule.tasks)), rule) for rule in self]
        best = sorted((s for s in support if s[0]), key=lambda s: (-s[0], -s[1].score))
        return [rule for _, rule in best[:k]]

    def state(self) -> list[Any]:
        """JSON-like state."""
        return [[rule.id, rule.text, rule.score, list(rule.tasks)] for rule in self]

    def load(self, state: Iterable[Any]) -> None:
        """Return to `state`."""
        self._rules = {id: Insight(id, text, score, tuple(tasks)) for id, text, score, tasks in state}


def first_neighbours(vectors: NDArray[np.float32]) -> list[list[int]]:
    """Clusters without a parameter: everyone is joined to the nearest other one (FINCH's first partition, Sarfraz et
    al., 2019).

    Args:
        vectors: unit vectors, shape (n, dim).

    Returns:
        Rows of each cluster, in order of their first member.
    """
    graph: Graph[int] = Graph()
    for i in range(len(vectors)):
        graph.add(i)
    if len(vectors) > 1:
        similarity = vectors @ vectors.T
        np.fill_diagonal(similarity, -np.inf)
        for i, nearest in enumerate(similarity.argmax(axis=1)):
            graph.connect(i, int(nearest))
    return graph.components()
