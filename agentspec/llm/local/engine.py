"""The loop that drives rows through the packed forward: reading and writing mixed, a bounded number of tokens at a
time.

Rows are sorted by their tokens, so that a row shares its longest prefix with the row before it: that part is copied,
not computed (the rollouts of one task, the samples of one request, the static text of all prompts). Each forward
takes the rows that are writing first and fills up with tokens still to be read: on a CPU a forward of 16 single
tokens costs nearly as much as one of 64, so writing beside another row's reading is almost free.

Between two forwards the jobs that are done can be exchanged for others, whose rows then join those that run
(continuous batching); who joins when is decided in `agentspec.llm.batching`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch

from agentspec.llm.local.adapters import active_adapter
from agentspec.llm.local.cache import PrefixCache
from agentspec.llm.local.forward import PackedModel, Segment
from agentspec.llm.local.invariance import version
from agentspec.llm.local.rows import ChoiceRow, FreeRow, Job, Row, ScoreRow
from agentspec.llm.local.sampling import choose, sample
from agentspec.llm.local.scheduler import Scheduler, schedule
from agentspec.tokens import shared_prefix

Exchange = Callable[[Sequence[Job]], Sequence[Job]]
"""Jobs that are done -> jobs that join."""

Watch = Callable[[int, int], None]
"""Told before a forward, of the rows that run: tokens of their prompts still to be read, tokens written so far."""

_TOKENS_PER_FORWARD = {"cpu": 512}
_DEFAULT_TOKENS = 8192


class Engine:
    """Runs jobs on a model, with a prefix cache.

    Args:
        model: the packed model.
        stop_ids: tokens that end a completion.
        decode: token ids to text.
        max_batch: rows that run at once.
        max_cache_tokens: bound of the prefix cache, and of what rows that run at once need.
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
        self._weights: tuple[int, int] | None = None
        self.watch: Watch | None = None

    def run(self, jobs: Sequence[Job], exchange: Exchange = lambda done: ()) -> None:
        """Fill in ``completions`` or ``scores``, and ``cached``, of every job.

        Args:
            jobs: what to begin with.
            exchange: called between two forwards with the jobs that are done (often none); returns those that join.
        """
        self.model.check()
        self._forget_old_weights()
        bounds = self._max_batch, self.cache.max_tokens
        adapter = active_adapter(self.model.model)
        scheduler = Scheduler(*bounds, self._room, adapter, self._stop_ids, self._decode)
        scheduler.add(jobs)
        with self.model.session():
            try:
                while scheduler.jobs:
                    self._run_adapter(scheduler, exchange)
                    # Some needed no forward.
                    scheduler.add(exchange(scheduler.collect()))
            finally:
                self.cache.drop_running()

    def _run_adapter(self, scheduler: Scheduler, exchange: Exchange) -> None:
        """Forwards with one adapter, as long as it has its turn."""
        adapter = scheduler.adapter
        budget = _TOKENS_PER_FORWARD.get(self.model.device.type, _DEFAULT_TOKENS)
        if not scheduler.rows:
            return
        with self.model.adapter(adapter):
            while scheduler.rows and scheduler.adapter == adapter:
                running = list(scheduler.running)
                self._place(scheduler.admit(), running)
                if self.watch:
                    prompts = [(len(row.job.prompt), row) for row in scheduler.running]
                    reading = sum(max(0, n - row.computed) for n, row in prompts)
                    self.watch(reading, sum(len(row.tokens) - n for n, row in prompts))
                self._advance(schedule(scheduler.running, budget))
                for row in scheduler.running:
                    if row.done:
                        self._finish(row, scheduler.running)
                scheduler.add(exchange(scheduler.collect()))

    def _room(self, row: Row) -> int:
        return self.model.room(row.room)

    def _place(self, rows: Sequence[Row], running: Sequence[Row]) -> None:
        """Give each row a slot with what is known of it, and the row before it as the source of what they share."""
        if not rows:
            return
        prompts = [(r.tokens, r.wanted, r.job.episode, self._room(r)) for r in rows]
        for row, slot in zip(rows, self.cache.assign(prompts, rows[0].job.adapter), strict=True):
            row.slot = slot
            _copy_longest(row, running)
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
        self.cache.trim()
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

    def _finish(self, row: Row, running: Sequence[Row]) -> None:
        """Keep the first sample's keys and values; the others' differ in a few tokens only."""
        if self.model.recorder is not None and not isinstance(row, ScoreRow):
            self.model.recorder.keep(row.job.episode, row.tokens[: row.slot.length], row.slot.seen)
        for other in running:
            if other.source is row:
                # From now on the slot may be continued by a row that joins.
                other.slot.copy_prefix(row.slot, other.computed)
                other.source, other.known = None, other.computed
        if row.index:
            self.cache.drop(row.slot)
        else:
            length = len(row.job.prompt) if isinstance(row, ScoreRow) else row.slot.length
            self.cache.put(row.slot, row.tokens[: min(length, row.slot.length)])
        del row.slot  # its job may take longer

    def invalidate(self) -> None:
        """Forget keys, values and packed weights: the weights changed."""
        self.cache.clear()
        self.model.invalidate()

    def _forget_old_weights(self) -> None:
        """Drop the cache when the weights of the model or of any adapter were written to since the last call."""
        parameters = list(self.model.model.parameters())
        weights = (sum(map(version, parameters)), sum(p.data_ptr() for p in parameters))
        if self._weights not in (None, weights):
            self.cache.clear()
        self._weights = weights


def _copy_longest(row: Row, running: Sequence[Row]) -> None:
    """Copy what a running row has computed of the tokens of ``row``, where that is more than its slot holds."""
    best, length = None, row.slot.length
    for other in running:
        stop = min(other.slot.length, row.wanted)
        # Comparing the next token first spares nearly all comparisons of whole prefixes.
        if length < stop and other.tokens[length] == row.tokens[length]:
            shared = shared_prefix(other.tokens[:stop], row.tokens[:stop])
            if shared > length:
                best, length = other, shared
    if best is not None:
        row.slot.copy_prefix(best.slot, length)
