"""Which rows run, which wait, which share the next forward, and which jobs are done."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from agentspec.llm.local.rows import Job, Row, SampleRow, ScoreRow


class Scheduler:
    """Rows in order of arrival; those that arrive together are sorted by their tokens, so that neighbours share most.

    Args:
        max_rows: rows that run at once.
        max_tokens: positions that rows running at once need (one row runs however many it needs).
        room: positions that a row needs.
        adapter: the adapter of jobs that name none.
        stop_ids: tokens that end a completion.
        decode: token ids to text.
    """

    def __init__(
        self,
        max_rows: int,
        max_tokens: int,
        room: Callable[[Row], int],
        adapter: str,
        stop_ids: frozenset[int],
        decode: Callable[[Sequence[int]], str],
    ) -> None:
        self.jobs: list[tuple[Job, list[Row]]] = []
        self.running: list[Row] = []
        self._waiting: list[Row] = []
        self._max_rows = max_rows
        self._max_tokens = max_tokens
        self._room = room
        self._default = adapter
        self._stop_ids = stop_ids
        self._decode = decode

    @property
    def rows(self) -> list[Row]:
        """Rows that are not done: those that run, then those that wait."""
        return [*self.running, *self._waiting]

    @property
    def adapter(self) -> str:
        """The adapter whose turn it is: that of the rows that run, else of the row that has waited longest."""
        return next((r.job.adapter for r in self.rows), self._default)

    def add(self, jobs: Sequence[Job]) -> None:
        """Put the rows of ``jobs`` at the end of the queue."""
        arrived = []
        for job in jobs:
            job.adapter = job.adapter or self._default
            rows = job.rows(self._stop_ids, self._decode)
            self.jobs.append((job, rows))
            arrived += [r for r in rows if not r.done]
        self._waiting += sorted(arrived, key=lambda r: r.tokens)

    def admit(self) -> list[Row]:
        """Let waiting rows run, as far as there is room; returns them.

        Rows of one adapter run at a time. While rows of another wait, nobody joins those that run: so every adapter
        has its turn, however many ask for this one.
        """
        adapter = self.adapter
        if self.running and any(r.job.adapter != adapter for r in self._waiting):
            return []
        held = sum(r.slot.capacity for r in self.running)
        joining: list[Row] = []
        for row in [r for r in self._waiting if r.job.adapter == adapter]:
            held += self._room(row)
            count = len(self.running) + len(joining)
            if count >= self._max_rows or (count and held > self._max_tokens):
                break
            joining.append(row)
        if joining:
            taken = set(map(id, joining))
            self._waiting = [r for r in self._waiting if id(r) not in taken]
            self.running += joining
        return joining

    def collect(self) -> list[Job]:
        """Take out what is done: the jobs, with their ``completions`` or ``scores`` filled in."""
        self.running = [r for r in self.running if not r.done]
        done = [(job, rows) for job, rows in self.jobs if all(r.done for r in rows)]
        if done:
            self.jobs = [(job, rows) for job, rows in self.jobs if not all(r.done for r in rows)]
        for job, rows in done:
            job.completions = tuple(r.completion() for r in rows if isinstance(r, SampleRow))
            job.scores = tuple(r.total for r in rows if isinstance(r, ScoreRow))
        return [job for job, _ in done]


def schedule(running: Sequence[Row], budget: int) -> list[tuple[Row, int]]:
    """Which rows read how many tokens in the next forward: short rests first, then long ones in order."""
    writing: list[tuple[Row, int]] = []
    reading: list[tuple[Row, int]] = []
    for row in running:
        rest = len(row.tokens) - row.computed
        # A row with a source waits for it in the queue of readers, however little it has to read itself.
        is_writing = row.source is None and row.computed >= len(row.job.prompt)
        (writing if is_writing else reading).append((row, rest))
    step, left = [], budget
    for row, rest in writing + reading:
        n = min(rest, left)
        if n <= 0:
            break
        step.append((row, n))
        left -= n
        if n < rest:
            # A later row may copy from this one: the order is kept.
            break
    return step
