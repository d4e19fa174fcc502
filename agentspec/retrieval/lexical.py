"""Search by words: BM25, exact, over postings in memory; SQLite's full-text index (FTS5) says what a word is.

A query is a bag of words: any document with one of them matches, and BM25 ranks (k1 = 1.2, b = 0.75 and the inverse
document frequency of FTS5: the scores are those of its `bm25()`). Words are split and stemmed as FTS5 does
(`porter unicode61`); each is looked up once per process. Equal scores keep the order of keys.

FTS5 itself scores every document that matches in a virtual machine, row by row. Here a word's documents are an array,
and a query adds one array per word. Words that stand in half of the documents or more weigh 0.000001 each, in SQLite
as here; they are left out as long as the others find enough: the order is the same but for scores that differ by less
than that.
"""

from __future__ import annotations

import math
import re
import sqlite3
import threading
import unicodedata
from array import array
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_WORD = re.compile(r"[^\W_]+")
_MOST_WORDS = 64
_K1, _B, _LEAST_WEIGHT = 1.2, 0.75, 1e-6
_MOST_STEMS = 200_000


@dataclass
class _Postings:
    """The documents that hold a word: their places, and how often each holds it; `live` are not removed."""

    places: array[int] = field(default_factory=lambda: array("q"))
    counts: array[float] = field(default_factory=lambda: array("d"))
    live: int = 0


class Lexical:
    """Keys (ints) with a text each, searched by BM25.

    A document's place is the order in which it was put; removed ones keep theirs until there are as many as others.
    """

    def __init__(self) -> None:
        self._words: dict[str, _Postings] = {}
        self._places: dict[int, int] = {}  # key -> place
        self._keys: list[int] = []  # place -> key
        self._held: list[Counter[str]] = []  # place -> its words; empty if it was removed
        self._lengths: array[float] = array("d")  # place -> words; 0 if it was removed
        self._total = 0  # words of all documents

    def __len__(self) -> int:
        return len(self._places)

    def put(self, key: int, text: str) -> None:
        """Add `text` under `key`, or replace what stands there."""
        self.remove(key)
        self._add(key, Counter(_tokens(text)))

    def remove(self, key: int) -> None:
        """Forget `key`; one that is not there is ignored."""
        place = self._places.pop(key, None)
        if place is None:
            return
        for word in self._held[place]:
            self._words[word].live -= 1
        self._total -= int(self._lengths[place])
        self._held[place], self._lengths[place] = Counter(), 0.0
        if len(self._keys) > 2 * len(self._places) + 16:
            self._pack()

    def search(self, query: str, k: int, *, where: Callable[[int], bool] | None = None) -> list[tuple[int, float]]:
        """The `k` best keys with their BM25 score (above 0, higher is better), best first.

        Args:
            where: keys it refuses are passed over.
        """
        words = [w for w in dict.fromkeys(_tokens(query)) if w in self._words and self._words[w].live][:_MOST_WORDS]
        if not words or k < 1:
            return []
        telling = [w for w in words if 2 * self._words[w].live < len(self)]
        found = self._ranked(telling, k, where) if telling else []
        return found if len(found) >= k or len(telling) == len(words) else self._ranked(words, k, where)

    def _ranked(self, words: list[str], k: int, where: Callable[[int], bool] | None) -> list[tuple[int, float]]:
        scores = self._scores(words)
        matching = np.flatnonzero(scores > 0)
        wanted = k if where is None else len(matching)
        if wanted < len(matching):  # only what may be among the first k is sorted
            least = np.partition(scores[matching], len(matching) - wanted)[len(matching) - wanted]
            matching = matching[scores[matching] >= least]
        keys = np.array([self._keys[place] for place in matching], dtype=np.int64)
        found: list[tuple[int, float]] = []
        for i in np.lexsort((keys, -scores[matching])):
            if len(found) >= k:
                break
            if where is None or where(int(keys[i])):
                found.append((int(keys[i]), float(scores[matching[i]])))
        return found

    def _scores(self, words: list[str]) -> NDArray[np.float64]:
        """Score of every place; 0 where nothing matches, and of what was removed."""
        lengths = np.array(self._lengths)
        weights = _K1 * (1 - _B + _B * lengths * len(self) / max(1, self._total))
        scores = np.zeros(len(lengths))
        for word in words:
            held = self._words[word]
            places, counts = np.array(held.places), np.array(held.counts)
            share = counts * (_K1 + 1) / (counts + weights[places])
            scores[places] += _weight(held.live, len(self)) * share
        scores[lengths == 0] = 0.0
        return scores

    def _add(self, key: int, held: Counter[str]) -> None:
        place = len(self._keys)
        self._places[key] = place
        self._keys.append(key)
        self._held.append(held)
        self._lengths.append(float(held.total()))
        self._total += held.total()
        for word, count in held.items():
            postings = self._words.get(word)
            if postings is None:
                postings = self._words[word] = _Postings()
            postings.places.append(place)
            postings.counts.append(float(count))
            postings.live += 1

    def _pack(self) -> None:
        """Give places anew, without those that were removed."""
        documents = [(key, self._held[place]) for key, place in self._places.items()]
        self.__init__()  # type: ignore[misc]
        for key, held in documents:
            self._add(key, held)


def _weight(holding: int, documents: int) -> float:
    """Inverse document frequency, as FTS5 has it."""
    return max(_LEAST_WEIGHT, math.log((documents - holding + 0.5) / (holding + 0.5)))


def _tokens(text: str) -> list[str]:
    """The words of a text as they are searched for, in order."""
    words = _words(text)
    missing = [w for w in dict.fromkeys(words) if w not in _STEMS.known and not _plain_number(w)]
    if missing:
        _STEMS.learn(missing)
    return [stem for w in words for stem in _STEMS.known.get(w, (w,))]


def _words(text: str) -> list[str]:
    return _WORD.findall(unicodedata.normalize("NFC", text).casefold())


def _plain_number(word: str) -> bool:
    return word.isascii() and word.isdigit()


class _Stems:
    """What FTS5's tokenizer makes of words: none, one, or several stems each. A pure function, remembered."""

    def __init__(self) -> None:
        self.known: dict[str, tuple[str, ...]] = {}
        self._lock = threading.Lock()
        self._db = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
        self._db.execute("CREATE VIRTUAL TABLE words USING fts5(word, tokenize='porter unicode61')")
        self._db.execute("CREATE VIRTUAL TABLE stems USING fts5vocab(words, instance)")

    def learn(self, words: Iterable[str]) -> None:
        """Look words up."""
        with self._lock:
            if len(self.known) > _MOST_STEMS:
                self.known = {}
            listed = list(words)
            self._db.execute("BEGIN")
            self._db.executemany("INSERT INTO words(rowid, word) VALUES (?, ?)", enumerate(listed))
            found: list[list[tuple[int, str]]] = [[] for _ in listed]
            for row, offset, stem in self._db.execute("SELECT doc, offset, term FROM stems"):
                found[row].append((offset, stem))
            self._db.execute("ROLLBACK")
            for word, stems in zip(listed, found, strict=True):
                self.known[word] = tuple(stem for _, stem in sorted(stems))


_STEMS = _Stems()
