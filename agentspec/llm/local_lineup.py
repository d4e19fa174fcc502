"""The rows of a running batch: who is in the forward, who waits for a place, which jobs are done."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from agentspec.llm.local_rows import Job, Row, SampleRow, ScoreRow


class Lineup:
    """Rows in order of arrival; those that arrive together are sorted by their tokens, so that neighbours share most.

    Args:
        places: rows that run at once.
        adapter: the adapter of jobs that name none.
        stop_ids: tokens that end a completion.
        decode: token ids to text.
    """

    def __init__(
        self, places: int, adapter: str, stop_ids: frozenset[int], decode: Callable[[Sequence[int]], str]
    ) -> None:
        self.jobs: list[tuple[Job, list[Row]]] = []
        self.running: list[Row] = []
        self._waiting: list[Row] = []
        self._places = places
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

    @property
    def rest(self) -> int:
        """Most tokens that a row still writes. What is only read does not count: reading leaves no room in a forward
        that another row could use.
        """
        return max((r.rest for r in self.rows), default=0)

    def add(self, jobs: Sequence[Job]) -> None:
        """Put the rows of ``jobs`` at the end of the line."""
        arrived = []
        for job in jobs:
            job.adapter = job.adapter or self._default
            rows = job.rows(self._stop_ids, self._decode)
            self.jobs.append((job, rows))
            arrived += [r for r in rows if not r.done]
        self._waiting += sorted(arrived, key=lambda r: r.tokens)

    def admit(self) -> list[Row]:
        """Give places to waiting rows, as far as there are any; they run from now on.

        Rows of one adapter run at a time. While rows of another wait, nobody joins those that run: so every adapter
        has its turn, however many ask for this one.
        """
        adapter = self.adapter
        if self.running and any(r.job.adapter != adapter for r in self._waiting):
            return []
        free = self._places - len(self.running)
        joining = [r for r in self._waiting if r.job.adapter == adapter][:free]
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
