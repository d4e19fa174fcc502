"""Blocking libraries beside the event loop: they run in a thread of their own and ask across.

Every memory has its own thread: a shared pool could be full of memories that wait for a batch of the model which other
memories, waiting for a thread, would have to join.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")


class Bridge:
    """Runs blocking work in one thread, and from within it coroutines and calls on the loop's thread."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="agentspec-memory")
        self._loop: asyncio.AbstractEventLoop | None = None
        self._home = 0  # the thread of the loop

    async def run(self, work: Callable[[], T]) -> T:
        """Do blocking work without blocking the loop."""
        self._loop, self._home = asyncio.get_running_loop(), threading.get_ident()
        return await self._loop.run_in_executor(self._executor, work)

    def ask(self, question: Coroutine[Any, Any, T]) -> T:
        """The result of a coroutine, from any thread but the loop's."""
        if self._loop is None:
            question.close()
            raise RuntimeError("a library asked the model outside of an episode")
        return asyncio.run_coroutine_threadsafe(question, self._loop).result()

    def call(self, function: Callable[[], T]) -> T:
        """The result of a plain call, made on the loop's thread: what episodes share is used from there only."""
        if self._loop is None or threading.get_ident() == self._home:
            return function()

        async def made() -> T:
            return function()

        return self.ask(made())
