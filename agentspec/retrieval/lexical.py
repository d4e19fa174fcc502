"""Search by words: BM25 over SQLite's full-text index (FTS5), in memory.

A query is a bag of words: any document with one of them matches, and BM25 ranks. Nothing in a query is read as FTS5's
own syntax. Equal scores keep the order of keys.
"""

from __future__ import annotations

import re
import sqlite3
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

    def __len__(self) -> int:
        return int(self._db.execute("SELECT count(*) FROM documents").fetchone()[0])

    def put(self, key: int, text: str) -> None:
        """Add `text` under `key`, or replace what stands there."""
        self.remove(key)
        self._db.execute("INSERT INTO documents(rowid, text) VALUES (?, ?)", (key, text))

    def remove(self, key: int) -> None:
        """Forget `key`; one that is not there is ignored."""
        self._db.execute("DELETE FROM documents WHERE rowid = ?", (key,))

    def search(self, query: str, k: int, *, where: Callable[[int], bool] | None = None) -> list[tuple[int, float]]:
        """The `k` best keys with their BM25 score (above 0, higher is better), best first.

        Args:
            where: keys it refuses are passed over.
        """
        words = list(dict.fromkeys(w.casefold() for w in _WORD.findall(query)))[:_MOST_WORDS]
        if not words or k < 1:
            return []
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
            db.execute("SELECT count(*) FROM documents").fetchone()
        except sqlite3.Error as error:
            raise ValueError(f"not a serialized lexical index ({len(image)} bytes): {error}") from error
        self._db.close()
        self._db = db


def _connect() -> sqlite3.Connection:
    return sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
