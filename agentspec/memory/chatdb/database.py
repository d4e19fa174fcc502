"""The database of ChatDB: steps and notes in SQLite, and a safe way to run what a model wrote.

SQL that a model wrote runs under an authorizer, for at most a fixed number of instructions of SQLite's machine (not
seconds, so that runs repeat), and gives at most so many rows.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from typing import Any

from agentspec.retrieval import Lexical
from agentspec.state import Json, joined

TABLES = """CREATE TABLE steps (id INTEGER PRIMARY KEY, episode INTEGER, step INTEGER, place TEXT, state TEXT,
  action TEXT, args TEXT, ok INTEGER, feedback TEXT, reward REAL);
CREATE TABLE notes (id INTEGER PRIMARY KEY, note TEXT);"""
COLUMNS = 10
LONGEST = 100_000  # bytes of a value or row: no statement can make a note of megabytes
MACHINE_STEPS = 1000  # SQLite instructions between two looks at the limit
FUNCTIONS = frozenset(
    (
        *(
            "abs",
            "avg",
            "coalesce",
            "count",
            "glob",
            "group_concat",
            "ifnull",
            "iif",
            "instr",
            "length",
            "like",
            "lower",
        ),
        *("ltrim", "max", "min", "nullif", "replace", "round", "rtrim", "substr", "substring", "sum", "total", "trim"),
        *("upper", "row_number", "rank", "dense_rank", "lag", "lead", "first_value", "last_value"),
    )
)


class Database:
    """Steps and notes in SQLite, and safe ways to ask for them.

    Args:
        instructions: most instructions of SQLite's machine for one statement that a model wrote.
    """

    def __init__(self, instructions: int = 1_000_000) -> None:
        self.instructions = instructions
        self._db = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
        self._db.executescript(TABLES)
        self._db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
        self._words: Lexical | None = None  # made when it is first asked
        self._rows: dict[int, Json] = {}  # the rows of `steps`, which nobody changes, as a snapshot has them

    def add(self, row: Sequence[Any]) -> None:
        """Insert a row of `steps`; without an id it gets the one after the highest."""
        values = tuple(row)
        cursor = self._db.execute(f"INSERT INTO steps VALUES ({','.join('?' * COLUMNS)})", values)
        id = int(cursor.lastrowid or 0)
        if self._words is not None:
            self._words.put(id, _words_of(values))
        self._rows[id] = Json.of([id, *values[1:]])

    def trim(self, steps: int, notes: int) -> int:
        """Keep the newest rows of each table; how many went."""
        old = list(self._rows)[: max(0, len(self._rows) - steps)] if len(self._rows) > steps else []
        for id in old:
            if self._words is not None:
                self._words.remove(id)
            del self._rows[id]
        self._db.executemany("DELETE FROM steps WHERE id = ?", [(id,) for id in old])
        newest = "SELECT id FROM notes ORDER BY id DESC LIMIT ?"
        return len(old) + self._db.execute(f"DELETE FROM notes WHERE id NOT IN ({newest})", (notes,)).rowcount

    def like(self, text: str, most: int) -> list[int]:
        """Ids of the steps that share words with a text, by BM25, best first."""
        if self._words is None:
            self._words = Lexical()
            for row in self.rows("SELECT * FROM steps ORDER BY id"):
                self._words.put(row[0], _words_of(row))
        return [key for key, _ in self._words.search(text, most)]

    def rows(self, sql: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """The rows of one of our own queries."""
        return self._db.execute(sql, tuple(values)).fetchall()

    def run(self, sql: str, limit: int) -> str:
        """What a statement that a model wrote gives, as text: rows, `done`, or `error: ...`; it never raises."""
        budget = [self.instructions // MACHINE_STEPS]

        def spend() -> int:
            budget[0] -= 1
            return int(budget[0] < 0)

        self._db.set_authorizer(_authorize)
        self._db.set_progress_handler(spend, MACHINE_STEPS)
        try:
            cursor = self._db.execute(sql)
            if cursor.description is None:
                return f"done ({max(0, cursor.rowcount)} rows)"
            names = [column[0] for column in cursor.description]
            found = cursor.fetchmany(limit + 1)
            cursor.close()
        except (sqlite3.Error, sqlite3.Warning, ValueError, OverflowError, MemoryError) as error:
            return "error: stopped, it takes too long" if budget[0] < 0 else f"error: {error}"
        finally:
            self._db.set_progress_handler(None, 0)
            self._db.set_authorizer(None)
        return table(names, found[:limit]) + ("\n(more rows are left out)" if len(found) > limit else "")

    def state(self) -> Json:
        """State as JSON: the rows of both tables."""
        notes = self.rows("SELECT id, note FROM notes ORDER BY id")
        return joined([joined(self._rows.values()), [[i, plain(note)] for i, note in notes]])

    def load(self, state: Sequence[Any]) -> None:
        """Return to `state`."""
        self._words, self._rows = None, {}
        self._db.execute("DELETE FROM steps")
        self._db.execute("DELETE FROM notes")
        for row in state[0]:
            self.add(row)
        self._db.executemany("INSERT INTO notes VALUES (?, ?)", state[1])


def _words_of(row: Sequence[Any]) -> str:
    """The words that a step is found by: place, state, action, arguments, feedback."""
    return " ".join(value for value in row[3:] if isinstance(value, str))


def plain(value: Any) -> Any:
    """A value as JSON and text can have it."""
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _authorize(action: int, first: str | None, second: str | None, database: str | None, source: str | None) -> int:
    """What a model's statement may do: read both tables, write notes, call harmless functions; nothing else."""
    if action in (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_RECURSIVE):
        return sqlite3.SQLITE_OK
    if action == sqlite3.SQLITE_READ and first in ("steps", "notes"):
        return sqlite3.SQLITE_OK
    if action == sqlite3.SQLITE_READ and not second and database is None:  # count(*) of a WITH clause
        return sqlite3.SQLITE_DENY if (first or "").casefold().startswith(("sqlite_", "pragma_")) else sqlite3.SQLITE_OK
    if action in (sqlite3.SQLITE_INSERT, sqlite3.SQLITE_UPDATE, sqlite3.SQLITE_DELETE) and first == "notes":
        return sqlite3.SQLITE_OK
    if action == sqlite3.SQLITE_FUNCTION and (second or "").casefold() in FUNCTIONS:
        return sqlite3.SQLITE_OK
    return sqlite3.SQLITE_DENY


def table(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Rows as text, one per line, with the columns' names."""
    if not rows:
        return "no rows"
    return "\n".join(", ".join(f"{n}: {plain(v)}" for n, v in zip(names, row, strict=True)) for row in rows)
