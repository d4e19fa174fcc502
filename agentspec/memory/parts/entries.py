"""What memories of short notes share: notes found by meaning and by words, and how they read.

A note says what is so in the environment's terms, and when that was seen: time is counted in environment steps, never
by a wall clock. What is not a note yet is in `waiting`.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agentspec.memory.parts.telling import NOTES
from agentspec.protocols import Embedder, Services
from agentspec.registry import SpecError
from agentspec.retrieval import Lexical, VectorIndex
from agentspec.services import Time
from agentspec.state import Json, Record, joined
from agentspec.types import Recall, RecallItem


@dataclass(frozen=True)
class Entry(Record):
    """One note.

    Args:
        id: never the same twice in a run.
        text: what is so, in one sentence.
        time: when it was seen.
        data: what else a method keeps of it; JSON values only.
    """

    id: int
    text: str
    time: Time = Time(0, 0, 0)
    data: Mapping[str, Any] = field(default_factory=dict)

    def row(self) -> list[Any]:
        return [self.id, self.text, numbers(self.time), dict(self.data)]

    @classmethod
    def load(cls, row: Sequence[Any]) -> Entry:
        """What `row` gave."""
        id, text, time, data = row
        return cls(id, text, Time(*time), data)


class Entries:
    """Notes by id, in order of insertion, found by meaning and (if `words`) by words.

    Args:
        embedder: text -> unit vector.
        capacity: most notes; beyond, the one that was written or confirmed longest ago is forgotten.
        words: whether `by_words` is used; it also searches `data["keywords"]`.
    """

    def __init__(self, embedder: Embedder, capacity: int, *, words: bool = False) -> None:
        self.capacity, self.evicted = capacity, 0
        self._by_id: dict[int, Entry] = {}
        self._place: dict[int, int] = {}  # id -> a number that grows in the order of insertion
        self._places = 0
        self._oldest: list[
            tuple[int, int, int]
        ] = []  # heap of (time, place, id); what has changed since is passed over
        self._saying: dict[str, dict[int, None]] = {}  # text -> notes that say exactly this
        self._vectors = VectorIndex(embedder)
        self._searched, self._words = words, Lexical() if words else None

    def __len__(self) -> int:
        return len(self._by_id)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._by_id.values())

    def __contains__(self, id: int) -> bool:
        return id in self._by_id

    def __getitem__(self, id: int) -> Entry:
        return self._by_id[id]

    def put(self, entry: Entry) -> list[Entry]:
        """Add a note, or replace the one with its id; the notes that had to be forgotten for it."""
        self._set(entry)
        self._vectors.put(entry.id, entry.text)
        if self._words is not None:
            self._words.put(entry.id, _words_of(entry))
        forgotten = []
        while len(self._by_id) > self.capacity:
            forgotten.append(self.remove(self._longest_ago()))
        self.evicted += len(forgotten)
        return [e for e in forgotten if e is not None]

    def remove(self, id: int) -> Entry | None:
        """Forget a note, and give it back; one that is not there is ignored."""
        entry = self._by_id.pop(id, None)
        if entry is None:
            return None
        self._said(entry)
        del self._place[id]
        self._vectors.remove(id)
        if self._words is not None:
            self._words.remove(id)
        return entry

    def confirm(self, text: str, time: Time) -> bool:
        """Whether a note says exactly `text`; it is then as new as `time`."""
        same = min(self._saying.get(text, ()), key=lambda id: self._place[id], default=None)
        if same is not None:
            self._set(replace(self._by_id[same], time=time))
        return same is not None

    def _set(self, entry: Entry) -> None:
        before = self._by_id.get(entry.id)
        if before is None:
            self._places += 1
            self._place[entry.id] = self._places
        else:
            self._said(before)
        self._by_id[entry.id] = entry
        self._saying.setdefault(entry.text, {})[entry.id] = None
        if before is None or before.time.total != entry.time.total:
            heapq.heappush(self._oldest, (entry.time.total, self._place[entry.id], entry.id))
            if len(self._oldest) > 2 * len(self._by_id) + 16:  # most of it has changed since
                self._oldest = [(e.time.total, self._place[e.id], e.id) for e in self]
                heapq.heapify(self._oldest)

    def _said(self, entry: Entry) -> None:
        """A note that says so no more."""
        saying = self._saying[entry.text]
        del saying[entry.id]
        if not saying:
            del self._saying[entry.text]

    def _longest_ago(self) -> int:
        """The note with the earliest time, of equals the one that was inserted first."""
        while True:
            total, place, id = heapq.heappop(self._oldest)
            if self._place.get(id) == place and self._by_id[id].time.total == total:
                return id

    def near(
        self, query: str, k: int, *, least: float = -1.0, where: Callable[[Entry], bool] | None = None
    ) -> list[tuple[Entry, float]]:
        """The `k` notes nearest in meaning with their cosine similarity (at least `least`), best first."""
        allowed = None if where is None else lambda id: where(self._by_id[id])
        return [(self._by_id[id], score) for id, score in self._vectors.search(query, k, where=allowed, least=least)]

    def by_words(
        self, query: str, k: int, *, where: Callable[[Entry], bool] | None = None
    ) -> list[tuple[Entry, float]]:
        """The `k` notes with the best BM25 score, best first."""
        if not self._searched:
            return []
        if self._words is None:  # since `load`
            self._words = Lexical()
            for e in self:
                self._words.put(e.id, _words_of(e))
        allowed = None if where is None else lambda id: where(self._by_id[id])
        return [(self._by_id[id], score) for id, score in self._words.search(query, k, where=allowed)]

    def embed(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Unit vectors, shape (len(texts), dim)."""
        return self._vectors.embedder.embed(list(texts))

    def similarity(self, query: str, id: int) -> float:
        """Cosine similarity of a text and a note."""
        return float(self._vectors.vector(id) @ self._vectors.embedder.embed([query])[0])

    def cosine(self, a: int, b: int) -> float:
        """Cosine similarity of two notes."""
        return float(self._vectors.vector(a) @ self._vectors.vector(b))

    def state(self) -> Json:
        """State as JSON; texts, not vectors."""
        return joined([self.evicted, joined(e.json for e in self)])

    def load(self, state: Sequence[Any]) -> None:
        """Return to `state`."""
        self.evicted, rows = state
        self._by_id, self._place, self._places, self._oldest, self._saying = {}, {}, 0, [], {}
        for row in rows:
            self._set(Entry.load(row))
        self._vectors.load([(e.id, e.text) for e in self])
        self._words = None


def numbers(time: Time) -> list[int]:
    """A time as it is kept in a state."""
    return [time.episode, time.step, time.total]


def _words_of(entry: Entry) -> str:
    """The words that a note is found by: its text's, and its keywords."""
    return " ".join((entry.text, *entry.data.get("keywords", ())))


class NoEmbedder:
    """Stands where a spec is checked without an embedder."""

    dim = 1

    def embed(self, texts: Sequence[str]) -> Any:
        """Refuse.

        Raises:
            SpecError: always.
        """
        raise SpecError("this memory needs an embedder; set `embedder: minilm` (or `hash`) in the spec")


def embedder_of(services: Services) -> Embedder:
    """The embedder that the spec names; without one, one that refuses as soon as it is used."""
    return services.embedder or NoEmbedder()


def stamp(time: Time, now: Time) -> str:
    """When something was seen, as a model reads it: steps and episodes count from 1.

    >>> stamp(Time(0, 6, 6), Time(0, 9, 9)), stamp(Time(0, 6, 6), Time(1, 0, 20))
    ('step 7', 'episode 1, step 7')
    """
    step = f"step {time.step + 1}"
    return step if time.episode == now.episode else f"episode {time.episode + 1}, {step}"


def one_line(text: str) -> str:
    """Text without line breaks and runs of blanks."""
    return " ".join(text.split())


def recalled(notes: Iterable[tuple[str, float]], lines: Sequence[str], source: str) -> Recall:
    """Notes, the best first, and after them the newest steps (which matter most), oldest first."""
    items = [RecallItem(text, score, "semantic", source, -i) for i, (text, score) in enumerate(notes)]
    newest = [RecallItem(line, kind="step", source=source, priority=1 + i) for i, line in enumerate(lines)]
    return Recall((*items, *newest))


def dated(entry: Entry, now: Time) -> str:
    """A note as it is shown: what is so, and when that was seen."""
    return f"- {entry.text} [{stamp(entry.time, now)}]"


__all__ = [
    "NOTES",
    "Entries",
    "Entry",
    "NoEmbedder",
    "dated",
    "embedder_of",
    "numbers",
    "one_line",
    "recalled",
    "stamp",
]
