"""The results file: one JSON line per episode, appended as episodes finish.

A run that was stopped goes on where it was: cells whose line is in the file are not played again. The only damage an
interrupted append can do is a last line without its end; it is cut off when the file is opened.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from agentspec.files import append_lines, jsonable, parse_line, repair_lines, whole_lines, write_lines

Cell = tuple[str, str, str, int]
"""(policy, scaffold, task key, rollout): what one line is about."""


def cell_of(row: Mapping[str, Any]) -> Cell:
    """The cell of a row."""
    return row["policy"], row["scaffold"], row["task"], int(row["rollout"])


class Results:
    """Rows by cell, and the file they are kept in.

    Args:
        out: the file if it ends in ``.jsonl``, else a folder in which it is ``results.jsonl``. Made when the first row
            is appended.

    Raises:
        ValueError: a line that is not a row of results, with its number.
    """

    def __init__(self, out: str | Path) -> None:
        out = Path(out)
        is_file = out.suffix == ".jsonl"
        self.path = out if is_file else out / "results.jsonl"
        self.trajectories = (out.with_suffix("") if is_file else out) / "trajectories"
        self.by_cell: dict[Cell, dict[str, Any]] = {}
        if self.path.is_file():
            self._read()

    @property
    def rows(self) -> list[dict[str, Any]]:
        """All rows, in the order in which their cells first appeared."""
        return list(self.by_cell.values())

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row, on disk at once."""
        data = jsonable(row)
        append_lines(self.path, data)
        self.by_cell[cell_of(data)] = data

    def discard(self, cells: Iterable[Cell]) -> None:
        """Drop the rows of ``cells``, on disk too: they are about to be played again."""
        unwanted = set(cells) & self.by_cell.keys()
        if not unwanted:
            return
        self.by_cell = {cell: row for cell, row in self.by_cell.items() if cell not in unwanted}
        write_lines(self.path, self.by_cell.values())

    def _read(self) -> None:
        repair_lines(self.path)
        for number, line in whole_lines(self.path):
            try:
                row = parse_line(self.path, number, line)
                self.by_cell[cell_of(row)] = row
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"{self.path}, line {number} is no row of results ({type(error).__name__}: {error}); "
                    "repair or remove the line, or choose another folder"
                ) from error
