"""When a request joins the running batch.

Episodes run as asyncio tasks. Each thinks, acts and asks the model at its own pace; a batch is worth most when nobody
is left who could still join it. So requests gather until every live episode has at least one pending; the loop is
then given a few turns, so that an episode that asks several things at once is complete, and the requests run as one
batch, ordered by episode and request id, in a worker thread while the loop goes on.

What happens when one answer is finished and others are still being written is :data:`Batching`. In a ``closed`` batch
all wait for the slowest. A continuous batch delivers the answer at once, so that its episode acts and asks again while
the others write, and takes new requests in between two steps of the work:

- ``ordered`` does so whenever a quarter of its episodes have been answered, unless the others are nearly done: it then
  waits until every live episode is in the batch, asks to join, or has left. Who is in the batch at each step depends
  on the work alone, never on timing, so a run can be repeated to the last bit, as with closed batches. The price is
  that the model stands still while the last of the quarter act: when answers are long, and environments take much
  longer than a step of the model, ``closed`` is faster.
- ``eager`` takes in whoever asks, and waits for nobody, or for a moment where episodes usually come back within one
  (:mod:`agentspec.llm.pace`): the fastest, most of all with slow environments. Who is in the batch depends on timing.
  Where arithmetic is batch-invariant (:meth:`~agentspec.llm.local_forward.PackedModel.invariant`) nothing else does,
  and a run can be repeated to the last bit all the same; elsewhere the batch's rounding makes a rerun differ in the
  last bits and, now and then, in a token.

An episode leaves when it ends; one that fails or is cancelled without saying so leaves when the task that entered it
ends. Requests without an episode, or from an episode that never entered, wait for nobody. As a last resort, for
episodes that wait on each other, a batch goes on when nothing new has come for ``patience_s``.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Generic, Literal, TypeVar, get_args

from agentspec.llm.pace import Pace

T = TypeVar("T")
Batching = Literal["ordered", "eager", "closed"]
"""Who joins a running batch: see the module."""

_TURNS = 4
_SHARE = 0.25
_NEARLY_DONE = 8
_POLL_S = 1.0


@dataclass(eq=False)
class _Pending(Generic[T]):
    episode: str
    number: int
    job: T
    done: asyncio.Future[None]
    finished: bool = False


@dataclass(eq=False)
class _Batch(Generic[T]):
    """What the worker is running, for which event loop; ``episodes``: live ones in it when it was last complete."""

    loop: asyncio.AbstractEventLoop
    jobs: list[_Pending[T]]
    episodes: int = 0


class Batcher(Generic[T]):
    """Gathers jobs of live episodes into batches.

    Args:
        run: works off a list of jobs, in place; called in one worker thread, one batch at a time. It may call
            :meth:`exchange` between two steps of its work.
        patience_s: seconds without a new request after which a batch runs although some live episode is not waiting.
        batching: see :data:`Batching`.

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
        self._pace = Pace()
        self._resumed = 0.0
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
        count = self._live.pop(episode, 0)
        if count > 1 and not every:
            self._live[episode] = count - 1
        self._pace.ended(episode)
        self._wake()

    async def submit(self, episode: str, number: int, job: T) -> None:
        """Wait until ``job`` has been run; ``number`` orders the jobs of one episode.

        Raises:
            Exception: whatever ``run`` raised for the batch.
        """
        self._adopt_loop()
        loop = asyncio.get_running_loop()
        pending = _Pending(episode, number, job, loop.create_future())
        self._pending.append(pending)
        self._pace.asked(episode)
        self._wake()
        try:
            await pending.done
        finally:
            # Cancelled while waiting: the others must not wait for it, nor the model work for it.
            if pending in self._pending:
                self._pending.remove(pending)
                self._wake()

    def exchange(self, done: Sequence[T], rest: int = 1 << 30) -> list[T]:
        """Deliver finished jobs and take those that join the batch; called by ``run``, in its thread.

        A closed batch delivers nothing and takes nothing. In an ``ordered`` one the jobs of one episode are delivered
        together, when the last is done, so that it is clear what to wait for; the call lasts as long as that takes.

        Args:
            done: jobs that are finished now.
            rest: most steps that the others still take.

        Raises:
            asyncio.CancelledError: nobody waits for the batch any more.
        """
        self._pace.worked(time.perf_counter() - self._resumed)
        try:
            return self._exchange_in_loop(done, rest)
        finally:
            self._resumed = time.perf_counter()

    def _exchange_in_loop(self, done: Sequence[T], rest: int) -> list[T]:
        idle = not done and not (self.batching == "eager" and self._pending)
        if self.batching == "closed" or idle or self._working is None:
            return []
        loop = self._working.loop
        exchanging = self._exchange(self._working, done, rest)
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

    async def _exchange(self, batch: _Batch[T], done: Sequence[T], rest: int) -> list[T]:
        """The loop's side of :meth:`exchange`."""
        delivered = self._batch is batch and self._deliver(batch, done)
        joining: list[_Pending[T]] = []
        under_way = not all(p.finished for p in batch.jobs)
        if under_way and (delivered or self.batching == "eager"):
            out = batch.episodes - self._episodes(batch)
            ordered = rest > _NEARLY_DONE and out >= max(1, _SHARE * batch.episodes)
            due = self.batching == "eager" or ordered
            worth_it = due and delivered
            patient = await self._wait(lambda: self._batch is not batch or not worth_it or self._complete())
            # A batch of strangers alone, who wait for nobody, must not keep the live episodes out.
            everybody = due or not patient or (not batch.episodes and self._complete())
            if self._batch is batch:
                joining = self._take(everybody)
                batch.jobs += joining
                if everybody:
                    batch.episodes = self._episodes(batch)
        if self._batch is not batch:
            raise asyncio.CancelledError("the batch was abandoned")
        return [p.job for p in joining]

    def _episodes(self, batch: _Batch[T]) -> int:
        return len({p.episode for p in batch.jobs} & self._live.keys())

    def _deliver(self, batch: _Batch[T], done: Sequence[T]) -> bool:
        """Whether anybody got an answer.

        The last of a batch get theirs when ``run`` returns: nothing may be under way any more when they go on.
        """
        finished = {id(job) for job in done}
        for p in batch.jobs:
            p.finished |= id(p.job) in finished
        left = [p for p in batch.jobs if not p.finished]
        if not left:
            return False
        busy = {p.episode for p in left if self.batching == "ordered" and p.episode in self._live}
        ready = [p for p in batch.jobs if p.finished and p.episode not in busy]
        batch.jobs = [p for p in batch.jobs if not p.finished or p.episode in busy]
        for p in ready:
            self._settle(p, None)
        return bool(ready)

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

    def _wake(self) -> None:
        if self._loop is None or self._loop.is_closed():
            return
        self._changed.set()
        if self._pending and (self._driver is None or self._driver.done()):
            self._driver = self._loop.create_task(self._drive())

    async def _drive(self) -> None:
        """Run batches while anybody asks."""
        while self._pending:
            patient = await self._wait(self._may_start)
            if jobs := self._take(self.batching == "eager" or self._complete() or not patient):
                await self._work_off(jobs)

    async def _work_off(self, jobs: list[_Pending[T]]) -> None:
        loop = asyncio.get_running_loop()
        batch = self._batch = _Batch(loop, jobs)
        batch.episodes = self._episodes(batch)
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
            for p in batch.jobs:
                self._settle(p, error)

    def _settle(self, pending: _Pending[T], error: BaseException | None) -> None:
        if pending.episode in self._live:
            self._pace.answered(pending.episode)
        _settle(pending.done, error)

    def _work(self, batch: _Batch[T]) -> None:
        self._working = batch
        self._resumed = time.perf_counter()
        self._run([p.job for p in batch.jobs])

    async def _wait(self, enough: Callable[[], bool]) -> bool:
        """Until there is ``enough``, and still is a few turns later; whether patience lasted."""
        patience = self._pace.grace_s if self.batching == "eager" else self._patience
        while True:
            self._changed.clear()
            if enough() or not patience:
                for _ in range(_TURNS):
                    await asyncio.sleep(0)
                if (satisfied := enough()) or not patience:
                    return satisfied
            else:
                try:
                    await asyncio.wait_for(self._changed.wait(), patience)
                except TimeoutError:
                    return False

    def _take(self, everybody: bool) -> list[_Pending[T]]:
        """The requests to run now, in order: all of them, or those that wait for nobody."""
        joining = [p for p in self._pending if everybody or p.episode not in self._live]
        self._pending = [p for p in self._pending if p not in joining]
        return sorted(joining, key=lambda p: (p.episode, p.number))

    def _complete(self) -> bool:
        """Every live episode waits on the model."""
        jobs = self._batch.jobs if self._batch else []
        return self._live.keys() <= {p.episode for p in [*self._pending, *jobs]}

    def _may_start(self) -> bool:
        """Nothing is gained by waiting (also: nothing is left to run)."""
        return not self._pending or self._complete() or any(p.episode not in self._live for p in self._pending)


def _settle(done: asyncio.Future[None], error: BaseException | None) -> None:
    if done.done():
        return
    if error is None:
        done.set_result(None)
    elif isinstance(error, asyncio.CancelledError):
        done.cancel()
    else:
        done.set_exception(error)
