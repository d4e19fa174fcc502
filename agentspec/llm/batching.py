"""When a request joins the running batch.

Episodes run as asyncio tasks: each thinks, acts and asks the model in its own time. `Batching` is one of two rules for
who shares a forward of the model with whom.

- `continuous`: whoever asks joins at the next step of the work, and an answer is delivered as soon as it is finished,
  so that its episode acts and asks again while the others write. Nobody waits for the slowest; who is in the batch
  depends on timing. Where arithmetic is batch-invariant (`agentspec.llm.local.invariance`) nothing else does, and a run
  repeats to the last bit; elsewhere a rerun differs in the last bits and, now and then, in a token.
- `closed`: a batch starts when every live episode waits on it, and all wait for its slowest answer. Who is in it
  depends on the work alone, never on timing, so that a run repeats whatever the arithmetic.

Before it takes requests either way, the event loop is given a few turns, so that an episode that asks several things at
once, or goes on at once, is complete. A continuous batch also gives those it has just answered a moment, at most a
quarter of what its last step took, to act and ask again: episodes that were in step stay in step, and share their
forwards. Where they took longer the last time, it does not wait. Requests are ordered by episode and number, and run in
a worker thread while the loop goes on.

An episode leaves when it ends; one that fails or is cancelled without saying so leaves when the task that entered it
ends. Requests without an episode, or from an episode that never entered, wait for nobody. As a last resort, for
episodes that wait on each other, a closed batch runs when nothing new has come for `patience_s`.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Generic, Literal, TypeVar, get_args

T = TypeVar("T")
Batching = Literal["continuous", "closed"]
"""Who joins a running batch: see the module."""

_TURNS = 4
_SHARE = 0.25
"""Of the duration of a step: how long a continuous batch waits for those it has just answered."""
_POLL_S = 1.0


@dataclass(eq=False)
class _Pending(Generic[T]):
    episode: str
    number: int
    job: T
    done: asyncio.Future[None]


@dataclass(eq=False)
class _Batch(Generic[T]):
    """What the worker is running, for which event loop."""

    loop: asyncio.AbstractEventLoop
    jobs: list[_Pending[T]]


class Batcher(Generic[T]):
    """Gathers jobs of live episodes into batches.

    Args:
        run: works off a list of jobs, in place; called in one worker thread, one batch at a time. It may call
            `exchange` between two steps of its work.
        patience_s: seconds without a new request after which a closed batch runs although some live episode is not
            waiting.
        batching: see `Batching`.

    Raises:
        ValueError: an unknown ``batching``.
    """

    def __init__(
        self, run: Callable[[Sequence[T]], None], *, patience_s: float = 60.0, batching: Batching = "closed"
    ) -> None:
        if batching not in get_args(Batching):
            raise ValueError(f"batching is {batching!r}; expected one of {', '.join(get_args(Batching))}")
        self.batching = batching
        self._run = run
        self._patience = patience_s
        self._live: dict[str, int] = {}
        self._pending: list[_Pending[T]] = []
        self._batch: _Batch[T] | None = None
        self._working: _Batch[T] | None = None  # the worker's own view: it may still be at an abandoned batch
        self._loop: asyncio.AbstractEventLoop | None = None
        self._driver: asyncio.Task[None] | None = None
        self._changed = asyncio.Event()
        self._answered: dict[str, float] = {}  # live episodes that act now, and since when
        self._awaited: set[str] = set()
        self._pause_s = self._step_s = self._stepped = 0.0
        self._thread = concurrent.futures.ThreadPoolExecutor(max_workers=1, thread_name_prefix="agentspec-llm")

    def enter(self, episode: str) -> None:
        """The episode goes live. An episode may enter more than once and then leaves as often."""
        try:
            task = asyncio.current_task()
        except RuntimeError:  # no loop runs: the caller will leave by itself
            task = None
        else:
            # Before the episode is counted: a new loop forgets the live episodes of the one before.
            self._adopt_loop()
        self._live[episode] = self._live.get(episode, 0) + 1
        if task is not None:
            task.add_done_callback(partial(self._task_ended, episode, self._live))

    def leave(self, episode: str, *, every: bool = False) -> None:
        """The episode ended (``every``: however often it entered); unknown episodes are ignored."""
        self._answered.pop(episode, None)
        count = self._live.pop(episode, 0)
        if count > 1 and not every:
            self._live[episode] = count - 1
        self._wake()

    async def submit(self, episode: str, number: int, job: T) -> None:
        """Wait until ``job`` has been run; ``number`` orders the jobs of one episode.

        Raises:
            Exception: whatever ``run`` raised for the batch.
        """
        self._adopt_loop()
        loop = asyncio.get_running_loop()
        if (since := self._answered.pop(episode, None)) is not None:
            self._pause_s = time.perf_counter() - since
        pending = _Pending(episode, number, job, loop.create_future())
        self._pending.append(pending)
        self._wake()
        try:
            await pending.done
        finally:
            # Cancelled while waiting: the others must not wait for it, nor the model work for it.
            if pending in self._pending:
                self._pending.remove(pending)
                self._wake()

    def exchange(self, done: Sequence[T]) -> list[T]:
        """Deliver finished jobs and take those that join the batch; called by `run`, in its thread.

        A closed batch delivers nothing and takes nothing.

        Args:
            done: jobs that are finished now.

        Raises:
            asyncio.CancelledError: nobody waits for the batch any more.
        """
        if self.batching == "closed" or self._working is None:
            return []
        self._step_s = time.perf_counter() - self._stepped
        try:
            return self._ask(self._working, done)
        finally:
            self._stepped = time.perf_counter()

    def _ask(self, batch: _Batch[T], done: Sequence[T]) -> list[T]:
        """The worker's side of `exchange`."""
        loop = batch.loop
        if not (done or self._pending or loop.is_closed()):
            return []
        exchanging = self._exchange(batch, done)
        try:
            future = asyncio.run_coroutine_threadsafe(exchanging, loop)
        except RuntimeError:
            exchanging.close()
            raise asyncio.CancelledError("the event loop of the batch is closed") from None
        while not loop.is_closed():
            try:
                return future.result(_POLL_S)
            except TimeoutError:
                continue
            except concurrent.futures.CancelledError:
                break
        raise asyncio.CancelledError("the event loop of the batch has ended")

    async def _exchange(self, batch: _Batch[T], done: Sequence[T]) -> list[T]:
        """The loop's side of `exchange`."""
        joining: list[_Pending[T]] = []
        if self._batch is batch and self._deliver(batch, done):
            await self._regroup()
            if self._batch is batch:
                joining = self._take(everybody=True)
                batch.jobs += joining
        if self._batch is not batch:
            raise asyncio.CancelledError("the batch was abandoned")
        return [p.job for p in joining]

    def _deliver(self, batch: _Batch[T], done: Sequence[T]) -> bool:
        """Give answers to those that are done; whether anything is still under way.

        The last of a batch get theirs when `run` returns: nothing may be under way any more when they go on.
        """
        finished = {id(job) for job in done}
        left = [p for p in batch.jobs if id(p.job) not in finished]
        if not left:
            return False
        self._settle_all([p for p in batch.jobs if id(p.job) in finished], None)
        batch.jobs = left
        return True

    def _settle_all(self, answered: Sequence[_Pending[T]], error: BaseException | None) -> None:
        """Deliver; those who have nothing else under way may ask again soon."""
        for p in answered:
            _settle(p.done, error)
        busy = {p.episode for p in [*self._pending, *(self._batch.jobs if self._batch else ())] if not p.done.done()}
        self._awaited = {p.episode for p in answered if p.episode in self._live} - busy
        self._answered |= dict.fromkeys(self._awaited, time.perf_counter())

    async def _regroup(self) -> None:
        """Give those just answered, and those who ask several things, time to ask."""
        await _turns()
        limit = _SHARE * self._step_s
        end = time.perf_counter() + limit
        while self._pause_s < limit and self._awaited & self._answered.keys():
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), end - time.perf_counter())
            except TimeoutError:
                break
        self._awaited = set()
        await _turns()

    def _task_ended(self, episode: str, live: dict[str, int], _: object) -> None:
        if self._live is live:
            self.leave(episode, every=True)

    def _adopt_loop(self) -> None:
        """Forget what belonged to an event loop that is gone."""
        loop = asyncio.get_running_loop()
        if self._loop is loop:
            return
        if self._loop is not None:
            self._live = {}
        self._loop, self._pending, self._driver, self._batch = loop, [], None, None
        self._changed = asyncio.Event()
        self._answered, self._awaited = {}, set()

    def _wake(self) -> None:
        if self._loop is None or self._loop.is_closed():
            return
        self._changed.set()
        if self._pending and (self._driver is None or self._driver.done()):
            self._driver = self._loop.create_task(self._drive())

    async def _drive(self) -> None:
        """Run batches while anybody asks."""
        while self._pending:
            if self.batching == "continuous":
                await self._regroup()
                jobs = self._take(everybody=True)
            else:
                patient = await self._wait(self._may_start)
                jobs = self._take(everybody=self._complete() or not patient)
            if jobs:
                await self._work_off(jobs)

    async def _work_off(self, jobs: list[_Pending[T]]) -> None:
        loop = asyncio.get_running_loop()
        batch = self._batch = _Batch(loop, jobs)
        error: BaseException | None = None
        try:
            await loop.run_in_executor(self._thread, self._work, batch)
        except asyncio.CancelledError:
            error = asyncio.CancelledError()
            raise
        except BaseException as raised:  # nobody may be left waiting, whatever it is
            error = raised
        finally:
            if self._batch is batch:
                self._batch = None
            self._settle_all(batch.jobs, error)

    def _work(self, batch: _Batch[T]) -> None:
        self._working = batch
        self._stepped = time.perf_counter()
        self._run([p.job for p in batch.jobs])

    async def _wait(self, enough: Callable[[], bool]) -> bool:
        """Until there is ``enough``, and still is a few turns later; whether patience lasted."""
        while True:
            self._changed.clear()
            if enough():
                await _turns()
                if enough():
                    return True
            else:
                try:
                    await asyncio.wait_for(self._changed.wait(), self._patience)
                except TimeoutError:
                    return False

    def _take(self, everybody: bool) -> list[_Pending[T]]:
        """The requests to run now, in order: all of them, or those that wait for nobody."""
        joining = [p for p in self._pending if everybody or p.episode not in self._live]
        self._pending = [p for p in self._pending if p not in joining]
        return sorted(joining, key=lambda p: (p.episode, p.number))

    def _complete(self) -> bool:
        """Every live episode waits on the model."""
        return self._live.keys() <= {p.episode for p in self._pending}

    def _may_start(self) -> bool:
        """Nothing is gained by waiting (also: nothing is left to run)."""
        return not self._pending or self._complete() or any(p.episode not in self._live for p in self._pending)


async def _turns() -> None:
    """Let those who can go on at once do so."""
    for _ in range(_TURNS):
        await asyncio.sleep(0)


def _settle(done: asyncio.Future[None], error: BaseException | None) -> None:
    if done.done():
        return
    if error is None:
        done.set_result(None)
    elif isinstance(error, asyncio.CancelledError):
        done.cancel()
    else:
        done.set_exception(error)
