"""Exact nearest neighbours by cosine similarity, in NumPy.

At the sizes of an agent's memory a matrix-vector product beats an approximate index: 10,000 vectors of 384 dimensions
are 15 MB. Vectors are unit length, so cosine similarity is the dot product. Equal scores keep the order of insertion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agentspec.protocols import Embedder

_FIRST_CAPACITY = 16


def top_rows(scores: NDArray[Any], k: int) -> NDArray[np.intp]:
    """Rows of the `k` greatest scores, best first; of equals the first ones.

    >>> top_rows(np.array([1.0, 3.0, 2.0, 3.0]), 3).tolist()
    [1, 3, 2]
    """
    rows = np.arange(len(scores))
    if 0 < k < len(scores):  # only what may be among the first k is sorted
        rows = np.flatnonzero(scores >= np.partition(scores, len(scores) - k)[len(scores) - k])
    return np.asarray(rows[np.argsort(-scores[rows], kind="stable")][: max(0, k)], dtype=np.intp)


class VectorIndex:
    """Keys (ints) with a text and its vector each.

    Args:
        embedder: text -> unit vector.

    The index keeps texts: `state()` is what a snapshot holds, and `load` embeds again (from the embedder's cache).
    """

    def __init__(self, embedder: Embedder) -> None:
        self.embedder = embedder
        self._matrix: NDArray[np.float32] = np.empty((0, embedder.dim), dtype=np.float32)
        self._keys: list[int] = []
        self._texts: list[str] = []
        self._row: dict[int, int] = {}
        self._gone: list[int] = []  # rows that were removed since the last search
        self._embedded = 0

    def __len__(self) -> int:
        return len(self._row)

    def __contains__(self, key: int) -> bool:
        return key in self._row

    def __iter__(self) -> Iterator[int]:
        return iter(self._row)

    def text(self, key: int) -> str:
        """The text stored under `key`."""
        return self._texts[self._row[key]]

    def put(self, key: int, text: str) -> None:
        """Add `text` under `key`, or replace what stands there (its place in the order stays)."""
        row = self._row.get(key)
        if row is None:
            self._row[key] = len(self._keys)
            self._keys.append(key)
            self._texts.append(text)
        elif self._texts[row] != text:
            self._texts[row] = text
            if row < self._embedded:
                self._matrix[row] = self.embedder.embed([text])[0]

    def remove(self, key: int) -> None:
        """Forget `key`; one that is not there is ignored."""
        row = self._row.pop(key, None)
        if row is not None:
            self._gone.append(row)

    def search(
        self, query: str, k: int, *, where: Callable[[int], bool] | None = None, least: float = -1.0
    ) -> list[tuple[int, float]]:
        """The `k` nearest keys with their cosine similarity, best first.

        Args:
            where: keys it refuses are passed over.
            least: smallest similarity that counts.
        """
        return self._best(self.scores(query), k, where, least)

    def scores(self, query: str) -> NDArray[np.float32]:
        """Cosine similarity of `query` to every text, in the order of the keys; shape (len(self),)."""
        self._settle()
        if not self._keys:
            return np.empty(0, dtype=np.float32)
        return np.asarray(self._matrix[: len(self._keys)] @ self.embedder.embed([query])[0], dtype=np.float32)

    def similar(self, key: int, k: int, *, least: float = -1.0) -> list[tuple[int, float]]:
        """As `search` with the text of `key`, without `key` itself."""
        return self.search(self.text(key), k, where=lambda other: other != key, least=least)

    def vector(self, key: int) -> NDArray[np.float32]:
        """Unit vector of `key`, shape (dim,)."""
        self._settle()
        return self._matrix[self._row[key]]

    def state(self) -> list[Any]:
        """JSON-like state: pairs of key and text, in order."""
        return [[key, self._texts[row]] for key, row in self._row.items()]

    def load(self, state: Sequence[Sequence[Any]]) -> None:
        """Return to `state`. Vectors are made when they are first needed."""
        self._keys = [int(key) for key, _ in state]
        self._texts = [str(text) for _, text in state]
        self._row = {key: row for row, key in enumerate(self._keys)}
        self._gone, self._embedded = [], 0

    def _best(
        self, scores: NDArray[np.float32], k: int, where: Callable[[int], bool] | None, least: float
    ) -> list[tuple[int, float]]:
        found: list[tuple[int, float]] = []
        looked_at, most = 0, k  # the best `most` rows are sorted; where too many are refused, four times as many
        while k > 0:
            rows = top_rows(scores, most)
            for row in rows[looked_at:]:
                if len(found) >= k or scores[row] < least:
                    return found
                key = self._keys[row]
                if where is None or where(key):
                    found.append((key, float(scores[row])))
            if len(rows) == len(scores):
                break
            looked_at, most = len(rows), 4 * most
        return found

    def _settle(self) -> None:
        """Close the gaps of what was removed, embed what is new."""
        if self._gone:
            kept = np.ones(len(self._keys), dtype=bool)
            kept[self._gone] = False
            rows = np.flatnonzero(kept)
            embedded = rows[: np.searchsorted(rows, self._embedded)]
            self._matrix[: len(embedded)] = self._matrix[embedded]
            self._embedded = len(embedded)
            self._keys, self._texts = [self._keys[i] for i in rows], [self._texts[i] for i in rows]
            self._row = {key: row for row, key in enumerate(self._keys)}
            self._gone = []
        self._embed_new()

    def _embed_new(self) -> None:
        count = len(self._keys)
        if self._embedded == count:
            return
        if count > len(self._matrix):
            grown = np.empty((max(count, 2 * len(self._matrix), _FIRST_CAPACITY), self.embedder.dim), dtype=np.float32)
            grown[: self._embedded] = self._matrix[: self._embedded]
            self._matrix = grown
        self._matrix[self._embedded : count] = self.embedder.embed(self._texts[self._embedded :])
        self._embedded = count
