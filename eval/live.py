"""A table that shows how an evaluation goes: episodes done, time left, tokens and dollars, per cell and per module.

On a terminal it is redrawn in place (with `rich`); elsewhere a line is printed now and then.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TextIO

from agentspec.progress import duration
from eval.cells import Cell, CellName, Planned
from eval.limits import taken
from eval.matrix import Observer
from eval.store import Record, Store

EVERY_S = 10.0


@dataclass
class Count:
    """What is known of one cell."""

    total: int
    done: int = 0
    failed: int = 0
    tokens: float = 0.0
    dollars: float = 0.0
    problem: str = ""
    modules: dict[str, float] = field(default_factory=dict)

    def add(self, record: Record) -> None:
        """Count an episode."""
        row = record["episode"]
        self.done += 1
        self.failed += row["status"] == "failed"
        tokens, dollars = taken(row)
        self.tokens += tokens
        self.dollars += dollars
        for name, sums in row.get("modules", {}).items():
            self.modules[name] = self.modules.get(name, 0.0) + sums["input_tokens"] + sums["output_tokens"]


class LiveTable(Observer):
    """Counts episodes and shows them.

    The time left is the mean time per episode played since the start, times those that are left; it holds as far as the
    rest takes as long as what was played.
    """

    def __init__(self, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.stream, self.clock = stream or sys.stderr, clock
        self.counts: dict[CellName, Count] = {}
        self.played, self.began, self.last = 0, clock(), -EVERY_S
        self._screen: Any = None

    def planned(self, cells: Sequence[Cell], store: Store) -> None:
        """Count what is there and start the table."""
        for cell in cells:
            count = self.counts[cell.name] = Count(sum(map(len, cell.chains)))
            for chain in cell.chains:
                for _, record, _ in cell.walk(store, chain):
                    if record is not None:
                        count.add(record)
        self.began = self.clock()
        if self.stream.isatty():
            try:
                from rich.console import Console
                from rich.live import Live
            except ImportError:
                return
            self._screen = Live(console=Console(file=self.stream), get_renderable=self._table, refresh_per_second=2)
            self._screen.start()

    def finished(self, cell: Cell, planned: Planned, record: Record) -> None:
        """Count an episode; a failure is said at once."""
        self.counts[cell.name].add(record)
        self.played += 1
        row = record["episode"]
        if row["status"] == "failed":
            self._say(f"{' / '.join(filter(None, cell.name))} / seed {row['seed']}: failed: {row['error']}")
        elif self._screen is None and self.clock() - self.last >= EVERY_S:
            self.last = self.clock()
            self._say(self.line())

    def failed(self, cells: Sequence[Cell], why: str) -> None:
        """Note why cells stop."""
        for cell in cells:
            self.counts[cell.name].problem = why
            self._say(f"{' / '.join(filter(None, cell.name))}: not played: {why}")

    def close(self) -> None:
        """Leave the last state on the screen."""
        if self._screen is not None:
            self._screen.stop()
        elif self.played:
            self._say(self.line())

    def line(self) -> str:
        """One line on the whole evaluation."""
        counts = self.counts.values()
        done, total = sum(c.done for c in counts), sum(c.total for c in counts)
        tokens, dollars = sum(c.tokens for c in counts), sum(c.dollars for c in counts)
        left = f", about {duration(self.left_s())} left" if self.played and done < total else ""
        spent = f", {tokens:,.0f} tokens" + (f", ${dollars:.2f}" if dollars else "")
        return f"{done}/{total} episodes{spent}{left}"

    def left_s(self) -> float:
        """Estimated seconds to the end."""
        left = sum(c.total - c.done for c in self.counts.values() if not c.problem)
        return (self.clock() - self.began) / max(1, self.played) * left

    def _say(self, text: str) -> None:
        if self._screen is not None:
            self._screen.console.print(text, markup=False)
        else:
            print(text, file=self.stream, flush=True)

    def _table(self) -> Any:
        from rich.table import Table

        table = Table(title=self.line())
        for name in ("policy", "scaffold", "episodes", "failed", "tokens", "$", "most tokens by"):
            table.add_column(name, justify="left" if name in ("policy", "scaffold", "most tokens by") else "right")
        for (policy, run, scaffold), c in self.counts.items():
            most = max(c.modules, key=c.modules.__getitem__, default="")
            share = f"{most} ({c.modules[most] / max(1.0, c.tokens):.0%})" if most else ""
            numbers = (f"{c.done}/{c.total}", str(c.failed), f"{c.tokens:,.0f}", f"{c.dollars:.2f}")
            table.add_row(f"{policy} {run}".strip(), scaffold, *numbers, c.problem[:60] or share)
        return table
