"""The memory stream of Generative Agents: what was seen and thought, scored by recency, importance and relevance.

Nothing here asks a model. Each of the three terms is scaled to [0, 1] over all memories (all equal: 0.5), weighted and
summed (Park et al., 2023, section 4.1):

    score = w_rec norm(decay ** age) + w_imp norm(importance) + w_rel norm(cosine)

`age` is in environment steps since a memory was last recalled (or written), so the newest is always the most recent.
(The authors' code sorts by age and then gives the oldest the highest recency.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agentspec.protocols import Embedder
from agentspec.retrieval import VectorIndex, top_rows
from agentspec.state import Json, Record, joined

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Memory(Record):
    """An event (the state, and a line that says what was done) or a thought (a line, and the ids it rests on).

    Args:
        step: of the episode, at which an event was (-1: it is none of its steps).
        failed: whether the environment could not do what was tried.
    """

    id: int
    line: str
    state: str = ""
    episode: int = 0
    thought: bool = False
    evidence: list[int] = field(default_factory=list)
    step: int = -1
    failed: bool = False

    def text(self) -> str:
        """What is embedded."""
        return f"{self.state} {self.line}" if self.state else self.line


@dataclass(frozen=True)
class Weights:
    """How much each term counts, and what recency loses per step."""

    recency: float
    importance: float
    relevance: float
    decay: float


class Stream:
    """Memories in the order they were written, at most `capacity`: the one used longest ago goes first.

    Args:
        embedder: `None` only for a stream that is never searched.
        weights: see `Weights`.
        capacity: most memories.
    """

    def __init__(self, embedder: Embedder | None, weights: Weights, capacity: int) -> None:
        self.weights, self.capacity = weights, capacity
        self._index = VectorIndex(embedder) if embedder else None
        self._memories: dict[int, Memory] = {}
        self._used: Floats = np.empty(0)
        self._importance: Floats = np.empty(0)
        self._row: dict[int, int] = {}
        self.evicted = 0

    def __len__(self) -> int:
        return len(self._memories)

    def __iter__(self) -> Iterator[Memory]:
        return iter(self._memories.values())

    def __contains__(self, id: int) -> bool:
        return id in self._memories

    def __getitem__(self, id: int) -> Memory:
        return self._memories[id]

    def importance(self, id: int) -> float:
        """Importance of a memory, as it was given."""
        return float(self._importance[self._row[id]])

    def rate(self, id: int, importance: float) -> None:
        """Give a memory another importance; one that is gone is ignored."""
        if id in self._row:
            self._importance[self._row[id]] = importance

    def add(self, memory: Memory, importance: float, now: int) -> None:
        """Write a memory; it counts as used at `now`."""
        while len(self._memories) >= self.capacity:
            self._evict()
        row = len(self._memories)
        if row >= len(self._used):
            self._grow(2 * row + 16)
        self._memories[memory.id] = memory
        self._row[memory.id] = row
        self._used[row], self._importance[row] = now, importance
        if self._index is not None:
            self._index.put(memory.id, memory.text())

    def scores(self, query: str, now: int) -> Floats:
        """The score of every memory, in the order they were written; shape (len(self),)."""
        n, w = len(self._memories), self.weights
        if self._index is None or not n:
            return np.zeros(n)
        recency = w.decay ** (now - self._used[:n])
        relevance = self._index.scores(query).astype(np.float64)
        terms = ((w.recency, recency), (w.importance, self._importance[:n]), (w.relevance, relevance))
        return sum((weight * normalised(term) for weight, term in terms), start=np.zeros(n))

    def recall(
        self, query: str, k: int, now: int, *, where: Callable[[Memory], bool] | None = None
    ) -> list[tuple[Memory, float]]:
        """The `k` best memories with their scores, best first; of equals the one written first. They count as used.

        Of memories that say the same (the steps of episodes of one task often do) only the best is recalled.

        Args:
            where: which memories may be recalled; all of them have their part in what the scores are scaled by.
        """
        scores, ids = self.scores(query, now), list(self._memories)
        best: dict[str, int] = {}
        for row in top_rows(scores, len(ids)):
            if len(best) >= k:
                break
            memory = self._memories[ids[row]]
            if where is None or where(memory):
                best.setdefault(memory.text(), int(row))
        rows = list(best.values())
        self._used[rows] = now
        return [(self._memories[ids[row]], float(scores[row])) for row in rows]

    def state(self) -> Json:
        """State as JSON."""
        n = len(self._memories)
        used, importance = self._used[:n].tolist(), self._importance[:n].tolist()
        return joined([joined(m.json for m in self), used, importance, self.evicted])

    def load(self, state: Sequence[Any]) -> None:
        """Return to `state`."""
        rows, used, importance, self.evicted = state
        self._memories = {row[0]: Memory(*row) for row in rows}
        self._row = {id: row for row, id in enumerate(self._memories)}
        self._used = np.array(used, dtype=np.float64)
        self._importance = np.array(importance, dtype=np.float64)
        if self._index is not None:
            self._index.load([(m.id, m.text()) for m in self])

    def _evict(self) -> None:
        n = len(self._memories)
        row = int(np.argmin(self._used[:n]))
        oldest = next(id for id, place in self._row.items() if place == row)
        for column in (self._used, self._importance):
            column[row : n - 1] = column[row + 1 : n].copy()
        del self._memories[oldest]
        self._row = {id: i for i, id in enumerate(self._memories)}
        if self._index is not None:
            self._index.remove(oldest)
        self.evicted += 1

    def _grow(self, size: int) -> None:
        n = len(self._memories)
        used, importance = np.empty(size), np.empty(size)
        used[:n], importance[:n] = self._used[:n], self._importance[:n]
        self._used, self._importance = used, importance


def normalised(values: Floats) -> Floats:
    """`values` scaled to [0, 1]; all 0.5 where they are equal.

    >>> normalised(np.array([2.0, 4.0, 3.0])).tolist(), normalised(np.array([7.0, 7.0])).tolist()
    ([0.0, 1.0, 0.5], [0.5, 0.5])
    """
    low, high = values.min(), values.max()
    scaled: Floats = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    return scaled
