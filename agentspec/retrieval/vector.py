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
        self._embedded = 0

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: int) -> bool:
        return key in self._row

    def __iter__(self) -> Iterator[int]:
        return iter(self._keys)

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
        if row is None:
            return
        del self._keys[row], self._texts[row]
        if row < self._embedded:
            self._matrix[row : self._embedded - 1] = self._matrix[row + 1 : self._embedded]
            self._embedded -= 1
        for later in range(row, len(self._keys)):
            self._row[self._keys[later]] = later

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
        self._embed_new()
        if not self._keys:
            return np.empty(0, dtype=np.float32)
        return np.asarray(self._matrix[: len(self._keys)] @ self.embedder.embed([query])[0], dtype=np.float32)

    def similar(self, key: int, k: int, *, least: float = -1.0) -> list[tuple[int, float]]:
        """As `search` with the text of `key`, without `key` itself."""
        return self.search(self.text(key), k, where=lambda other: other != key, least=least)

    def vector(self, key: int) -> NDArray[np.float32]:
        """Unit vector of `key`, shape (dim,)."""
        self._embed_new()
        return self._matrix[self._row[key]]

    def state(self) -> list[Any]:
        """JSON-like state: pairs of key and text, in order."""
        return [[key, text] for key, text in zip(self._keys, self._texts, strict=True)]

    def load(self, state: Sequence[Sequence[Any]]) -> None:
        """Return to `state`. Vectors are made when they are first needed."""
        self._keys = [int(key) for key, _ in state]
        self._texts = [str(text) for _, text in state]
        self._row = {key: row for row, key in enumerate(self._keys)}
        self._embedded = 0

    def _best(
        self, scores: NDArray[np.float32], k: int, where: Callable[[int], bool] | None, least: float
    ) -> list[tuple[int, float]]:
        if where is None and 0 < k < len(scores):
            # Only what may be among the first k is sorted; all that equal the k-th score stay in, so ties keep order.
            kth = np.partition(scores, len(scores) - k)[len(scores) - k]
            candidates = np.flatnonzero(scores >= max(float(kth), least))
        else:
            candidates = np.flatnonzero(scores >= least)
        order = candidates[np.argsort(-scores[candidates], kind="stable")]
        found: list[tuple[int, float]] = []
        for row in order:
            if len(found) >= k:
                break
            key = self._keys[row]
            if where is None or where(key):
                found.append((key, float(scores[row])))
        return found

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
