"""The loop that drives rows through the packed forward: reading and writing mixed, a bounded number of tokens at a
time.

Rows are sorted by their tokens, so that a row shares its longest prefix with the row before it: that part is copied,
not computed (the rollouts of one task, the samples of one request, the static text of all prompts). Each forward
takes the rows that are writing first and fills up with tokens still to be read: on a CPU a forward of 16 single
tokens costs nearly as much as one of 64, so writing beside another row's reading is almost free.

:meth:`Engine.run` works off one closed set of jobs. Continuous batching would admit rows between two turns of its loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch

from agentspec.llm.local_cache import PrefixCache
from agentspec.llm.local_forward import PackedModel, Segment
from agentspec.llm.local_rows import ChoiceRow, FreeRow, Job, Row, SampleRow, ScoreRow, choose, sample
from agentspec.tokens import shared_prefix

_TOKENS_PER_FORWARD = {"cpu": 512}
_DEFAULT_TOKENS = 8192


class Engine:
    """Runs jobs on a model, with a prefix cache.

    Args:
        model: the packed model.
        stop_ids: tokens that end a completion.
        decode: token ids to text.
        max_batch: rows that run at once.
        max_cache_tokens: bound of the prefix cache.
    """

    def __init__(
        self,
        model: PackedModel,
        *,
        stop_ids: frozenset[int],
        decode: Callable[[Sequence[int]], str],
        max_batch: int,
        max_cache_tokens: int,
    ) -> None:
        self.model = model
        self.cache = PrefixCache(model.layers, max_cache_tokens)
        self._stop_ids = stop_ids
        self._decode = decode
        self._max_batch = max_batch
        self._weights: tuple[int, int, str] | None = None

    def run(self, jobs: Sequence[Job]) -> None:
        """Fill in ``completions`` or ``scores``, and ``cached``, of every job."""
        self.model.check()
        self._forget_old_weights()
        rows = [row for job in jobs for row in job.rows(self._stop_ids, self._decode)]
        todo = sorted((r for r in rows if not r.done), key=lambda r: r.tokens)
        with self.model.session():
            for start in range(0, len(todo), self._max_batch):
                self._run_group(todo[start : start + self._max_batch])
        self._collect(rows)

    def _run_group(self, rows: list[Row]) -> None:
        self._place(rows)
        budget = _TOKENS_PER_FORWARD.get(self.model.device.type, _DEFAULT_TOKENS)
        active = rows
        while active:
            step = _schedule(active, budget)
            self._advance(step)
            for row, _ in step:
                if row.done:
                    self._finish(row)
            active = [r for r in active if not r.done]

    def _place(self, rows: list[Row]) -> None:
        """Give each row a slot with what is cached, and the row before it as the source of what they share."""
        prompts = [(r.tokens, r.wanted, r.job.episode, r.room) for r in rows]
        for row, slot in zip(rows, self.cache.assign(prompts), strict=True):
            row.slot = slot
            row.computed = row.known = slot.length
        for before, row in pairwise(rows):
            shared = min(shared_prefix(before.tokens, row.tokens), row.wanted)
            if shared > row.known:
                row.source, row.computed = before, shared
        for row in rows:
            if row.index == 0:
                row.job.cached = min(row.computed, len(row.job.prompt))

    def _advance(self, step: Sequence[tuple[Row, int]]) -> None:
        """One forward: each row reads the given number of tokens; those that are through sample."""
        segments = []
        for row, n in step:
            stop = row.computed + n
            wanted = max(0, stop - max(row.wanted, row.computed))
            tokens = row.tokens[row.computed : stop]
            source = row.source.slot if row.source else None
            segments.append(Segment(row.slot, tokens, row.computed, wanted, source, row.known))
        outputs = self.model.forward(segments)
        choosing: list[tuple[ChoiceRow, torch.Tensor]] = []
        writing: list[tuple[FreeRow, torch.Tensor]] = []
        for (row, n), logits in zip(step, outputs, strict=True):
            row.computed += n
            row.source = None
            if not logits.shape[0]:
                continue
            if isinstance(row, ScoreRow):
                row.feed(logits)
            elif isinstance(row, ChoiceRow):
                choosing.append((row, logits))
            elif isinstance(row, FreeRow):
                writing.append((row, logits))
        if choosing:
            choose([r for r, _ in choosing], torch.cat([x for _, x in choosing]))
        if writing:
            sample([r for r, _ in writing], torch.cat([x for _, x in writing]))

    def _finish(self, row: Row) -> None:
        """Keep the first sample's keys and values; the others' differ in a few tokens only."""
        if row.index == 0:
            length = len(row.job.prompt) if isinstance(row, ScoreRow) else row.slot.length
            self.cache.put(row.slot, row.tokens[: min(length, row.slot.length)])

    def _collect(self, rows: Sequence[Row]) -> None:
        for row in rows:
            if isinstance(row, ScoreRow):
                row.job.scores += (row.total,)
            elif isinstance(row, SampleRow):
                row.job.completions += (row.completion(),)

    def _forget_old_weights(self) -> None:
        """Drop the cache when the weights were written to, or another adapter chosen, since the last call."""
        model = self.model.model
        parameters = [p for p in model.parameters() if not p.is_inference()]
        adapter = str(getattr(model, "active_adapter", ""))
        weights = (sum(p._version for p in parameters), sum(p.data_ptr() for p in parameters), adapter)
        if self._weights not in (None, weights):
            self.cache.clear()
        self._weights = weights


def _schedule(active: Sequence[Row], budget: int) -> list[tuple[Row, int]]:
    """Which rows read how many tokens in the next forward: short rests first, then long ones in order."""
    writing: list[tuple[Row, int]] = []
    reading: list[tuple[Row, int]] = []
    for row in active:
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
