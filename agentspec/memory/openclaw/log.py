"""The logs of OpenClaw: entries in the order in which they were written, found by meaning and by words."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from agentspec.memory.openclaw.search import Chunk, hybrid
from agentspec.protocols import Embedder
from agentspec.retrieval import Lexical, VectorIndex
from agentspec.state import Json, keyed


class Log:
    """Log entries by key.

    Args:
        embedder: `None` only for a log that is searched by words alone.
        capacity: most entries; the oldest go first.
    """

    def __init__(self, embedder: Embedder | None, capacity: int) -> None:
        self.embedder, self.capacity = embedder, capacity
        self._chunks: dict[int, Chunk] = {}
        self._clear()

    def __len__(self) -> int:
        return len(self._chunks)

    def __iter__(self) -> Iterator[int]:
        return iter(self._chunks)

    def __getitem__(self, key: int) -> Chunk:
        return self._chunks[key]

    def values(self) -> list[Chunk]:
        """All entries, oldest first."""
        return list(self._chunks.values())

    def append(self, key: int, chunk: Chunk) -> None:
        """Write an entry."""
        self._chunks[key] = chunk
        self._index(key)
        while len(self._chunks) > self.capacity:
            oldest = next(iter(self._chunks))
            del self._chunks[oldest]
            self._words.remove(oldest)
            if self._vectors is not None:
                self._vectors.remove(oldest)

    def recalled(self, key: int, score: float, query: str, episode: int) -> Chunk:
        """Count a recall of an entry."""
        self._chunks[key] = self._chunks[key].recalled(score, query, episode)
        return self._chunks[key]

    def promote(self, key: int) -> None:
        """What an entry says stands in `MEMORY.md` by now."""
        self._chunks[key] = replace(self._chunks[key], promoted=True)

    def search(self, query: str, k: int, *, diverse: bool) -> list[tuple[int, float]]:
        """See `hybrid`."""
        return hybrid(self._vectors, self._words, query, k, diverse=diverse)

    def of(self, episode: int) -> list[Chunk]:
        """The entries of the newest episode, if it is this one; oldest first."""
        return list(itertools.takewhile(lambda c: c.episode == episode, reversed(self._chunks.values())))[::-1]

    def notes(self, since: int, most: int) -> list[Chunk]:
        """The newest notes of the episodes from `since` on, at most so many; oldest first."""
        recent = itertools.takewhile(lambda c: c.episode >= since, reversed(self._chunks.values()))
        return list(itertools.islice((c for c in recent if c.note), most))[::-1]

    def state(self) -> Json:
        """State as JSON."""
        return keyed(self._chunks)

    def load(self, state: Sequence[Any]) -> None:
        """Return to `state`."""
        self._chunks = {key: Chunk.load(row) for key, row in state}
        self._clear()
        for key in self._chunks:
            self._index(key)

    def _clear(self) -> None:
        self._words = Lexical()
        self._vectors = VectorIndex(self.embedder) if self.embedder is not None else None

    def _index(self, key: int) -> None:
        self._words.put(key, self._chunks[key].text)
        if self._vectors is not None:
            self._vectors.put(key, self._chunks[key].text)
