"""When to run a batch: once every live episode waits on the model.

Episodes run as asyncio tasks. Each thinks, acts and asks the model at its own pace; a batch is worth most when nobody
is left who could still join it. So requests gather until every live episode has at least one pending; the loop is
then given a few turns, so that an episode that asks several things at once is complete, and the requests run as one
batch, ordered by episode and request id, in a worker thread while the loop goes on. Membership, and so the batch,
does not depend on timing.

An episode leaves when it ends; one that fails or is cancelled without saying so leaves when the task that entered it
ends. Requests without an episode, or from an episode that never entered, wait for nobody. As a last resort, for
episodes that wait on each other, a batch runs when nothing new has come for ``patience_s``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

T = TypeVar("T")
_TURNS = 4


@dataclass
class _Pending(Generic[T]):
    episode: str
    number: int
    job: T
    done: asyncio.Future[None]


class Batcher(Generic[T]):
    """Gathers jobs of live episodes into batches.

    Args:
        run: works off a list of jobs, in place; called in one worker thread, one batch at a time.
        patience_s: seconds without a new request after which a batch runs although some live episode is not waiting.
    """

    def __init__(self, run: Callable[[Sequence[T]], None], *, patience_s: float = 60.0) -> None:
        self._run = run
        self._patience = patience_s
        self._live: dict[str, int] = {}
        self._pending: list[_Pending[T]] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._flusher: asyncio.Task[None] | None = None
        self._running = False
        self._timer: asyncio.TimerHandle | None = None
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="agentspec-llm")

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
        self._wake()
        try:
            await pending.done
        finally:
            # Cancelled while waiting: the others must not wait for it, nor the model work for it.
            if pending in self._pending:
                self._pending.remove(pending)
                self._wake()

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
        self._loop, self._pending, self._flusher, self._running, self._timer = loop, [], None, False, None

    def _ready(self) -> bool:
        if not self._pending or self._running:
            return False
        waiting = {p.episode for p in self._pending}
        return all(episode in waiting for episode in self._live)

    def _wake(self) -> None:
        if self._loop is None or self._loop.is_closed():
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._pending and not self._running:
            self._timer = self._loop.call_later(self._patience, self._start, True)
            if self._ready() or any(p.episode not in self._live for p in self._pending):
                self._start(False)

    def _start(self, impatient: bool) -> None:
        assert self._loop is not None
        if self._flusher is None or self._flusher.done():
            self._flusher = self._loop.create_task(self._flush(impatient))

    async def _flush(self, impatient: bool) -> None:
        for _ in range(_TURNS):
            await asyncio.sleep(0)
        batch = self._take(impatient)
        if not batch:
            return
        self._running = True
        error: BaseException | None = None
        try:
            await asyncio.get_running_loop().run_in_executor(self._thread, self._run, [p.job for p in batch])
        except asyncio.CancelledError:
            error = asyncio.CancelledError()
            raise
        except BaseException as raised:  # nobody may be left waiting, whatever it is
            error = raised
        finally:
            self._running = False
            for p in batch:
                _settle(p.done, error)
            # Next: what asked meanwhile.
            asyncio.get_running_loop().call_soon(self._again)

    def _take(self, impatient: bool) -> list[_Pending[T]]:
        """The requests to run now, in order: all of them, or those that wait for nobody."""
        if self._running:
            return []
        if impatient or self._ready():
            batch, self._pending = self._pending, []
        else:
            batch = [p for p in self._pending if p.episode not in self._live]
            self._pending = [p for p in self._pending if p.episode in self._live]
        return sorted(batch, key=lambda p: (p.episode, p.number))

    def _again(self) -> None:
        self._flusher = None
        self._wake()


def _settle(done: asyncio.Future[None], error: BaseException | None) -> None:
    if done.done():
        return
    if error is None:
        done.set_result(None)
    elif isinstance(error, asyncio.CancelledError):
        done.cancel()
    else:
        done.set_exception(error)
