"""Search by words: BM25 over SQLite's full-text index (FTS5), in memory.

A query is a bag of words: any document with one of them matches, and BM25 ranks. Nothing in a query is read as FTS5's
own syntax. Equal scores keep the order of keys.

A word that stands in half of the documents or more weighs 0.000001 in SQLite's BM25 and costs as much time as there are
documents. Such words are left out as long as the others find enough: the order is the same but for scores that differ
by less than that.
"""

from __future__ import annotations

import re
import sqlite3
import unicodedata
from collections.abc import Callable

_WORD = re.compile(r"[^\W_]+")
_MOST_WORDS = 64


class Lexical:
    """Keys (ints) with a text each, searched by BM25.

    A connection belongs to one instance and may be used from any one thread at a time.
    """

    def __init__(self) -> None:
        self._db = _connect()
        self._db.execute("CREATE VIRTUAL TABLE documents USING fts5(text, tokenize='porter unicode61')")
        self._count = 0
        self._holding: dict[str, int] = {}  # word -> documents that certainly hold it (other forms are not counted)

    def __len__(self) -> int:
        return self._count

    def put(self, key: int, text: str) -> None:
        """Add `text` under `key`, or replace what stands there."""
        self.remove(key)
        self._db.execute("INSERT INTO documents(rowid, text) VALUES (?, ?)", (key, text))
        self._counted(text, 1)

    def remove(self, key: int) -> None:
        """Forget `key`; one that is not there is ignored."""
        row = self._db.execute("SELECT text FROM documents WHERE rowid = ?", (key,)).fetchone()
        if row is not None:
            self._db.execute("DELETE FROM documents WHERE rowid = ?", (key,))
            self._counted(row[0], -1)

    def search(self, query: str, k: int, *, where: Callable[[int], bool] | None = None) -> list[tuple[int, float]]:
        """The `k` best keys with their BM25 score (above 0, higher is better), best first.

        Args:
            where: keys it refuses are passed over.
        """
        words = list(dict.fromkeys(w.casefold() for w in _WORD.findall(query)))[:_MOST_WORDS]
        if not words or k < 1:
            return []
        telling = [w for w in words if 2 * self._holding.get(w, 0) < self._count]
        found = self._ranked(telling, k, where) if telling else []
        return found if len(found) >= k or len(telling) == len(words) else self._ranked(words, k, where)

    def _ranked(self, words: list[str], k: int, where: Callable[[int], bool] | None) -> list[tuple[int, float]]:
        match = " OR ".join(f'"{w}"' for w in words)
        limit = k if where is None else -1
        rows = self._db.execute(
            "SELECT rowid, -rank FROM documents WHERE documents MATCH ? ORDER BY rank, rowid LIMIT ?",
            (match, limit),
        )
        found: list[tuple[int, float]] = []
        for key, score in rows:
            if len(found) >= k:
                break
            if where is None or where(key):
                found.append((int(key), float(score)))
        return found

    def _counted(self, text: str, change: int) -> None:
        """Count the words of a document that came (1) or went (-1)."""
        self._count += change
        for word in _certain(text):
            left = self._holding.get(word, 0) + change
            if left:
                self._holding[word] = left
            else:
                del self._holding[word]

    def serialize(self) -> bytes:
        """The whole index as a SQLite database image."""
        return self._db.serialize()

    def deserialize(self, image: bytes) -> None:
        """Return to what `serialize` gave.

        Raises:
            ValueError: not an image of such an index.
        """
        db = _connect()
        try:
            db.deserialize(image)
            texts = db.execute("SELECT text FROM documents").fetchall()
        except sqlite3.Error as error:
            raise ValueError(f"not a serialized lexical index ({len(image)} bytes): {error}") from error
        self._db.close()
        self._db = db
        self._count, self._holding = 0, {}
        for (text,) in texts:
            self._counted(text, 1)


def _certain(text: str) -> set[str]:
    """The words that FTS5 finds in a text just as written here: ASCII, and no mark near that would join them."""
    if not text.isascii() and any(unicodedata.category(c)[0] in "MC" for c in text if ord(c) > 127):
        return set()
    return {w.lower() for w in _WORD.findall(text) if w.isascii()}


def _connect() -> sqlite3.Connection:
    return sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
