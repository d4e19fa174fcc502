"""What memories of libraries share: the steps they are told of, their cadence, and what happens when one fails.

A library may raise at an answer that it cannot read, or swallow an error that is none of its own. So whatever it raises
while it writes or searches is counted (`memory/problems/library`, with the text in `memory/last_error`) and the episode
goes on without it, while what the model's backend raised is raised again, whether or not the library let it through.
"""

from __future__ import annotations

import importlib.util
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Awaitable, Sequence
from functools import cached_property
from typing import Any, ClassVar, TypeVar

from agentspec.llm.base import Message
from agentspec.memory.parts.entries import recalled
from agentspec.memory.parts.waiting import Step, shown_lines
from agentspec.parameters import at_least
from agentspec.registry import SpecError
from agentspec.services import Answer, Services
from agentspec.state import dump_state, load_state
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, Task, Transition

T = TypeVar("T")

TELEMETRY = {
    **{"MEM0_TELEMETRY": "False", "GRAPHITI_TELEMETRY_ENABLED": "false", "ANONYMIZED_TELEMETRY": "False"},
    **{"LANGSMITH_TRACING": "false", "LANGSMITH_TRACING_V2": "false"},
    **{"LANGCHAIN_TRACING": "false", "LANGCHAIN_TRACING_V2": "false"},
}
"""Variables that switch off what these libraries would send home."""


def telemetry_off() -> None:
    """Set the variables; to be called before a library is imported."""
    os.environ.update(TELEMETRY)


def require(name: str, package: str, extra: str) -> None:
    """Refuse a library that is not installed, without importing it.

    Raises:
        SpecError: how to install it.
    """
    if importlib.util.find_spec(package) is None:
        raise SpecError(f"memory {name!r} needs {package}, which is not installed: pip install 'agentspec-rl[{extra}]'")


class Asker:
    """The metered model as a library is given it; remembers what the backend raised.

    Args:
        services: of the module.
        tokens: most tokens of an answer.
    """

    def __init__(self, services: Services, tokens: int) -> None:
        self.services, self.tokens = services, tokens
        self.failed: Exception | None = None

    async def __call__(self, purpose: str, messages: Sequence[Message], parse: Any = None) -> Answer[Any]:
        """Ask; see `Services.ask`. An answer that cannot be read is not asked for again: libraries do that themselves.

        Raises:
            Exception: what the backend raised.
        """
        try:
            return await self.services.ask(purpose, messages, self.tokens, parse)
        except Exception as error:
            self.failed = error
            raise

    def raise_failed(self) -> None:
        """Raise what the backend raised since this was last asked."""
        error, self.failed = self.failed, None
        if error is not None:
            raise error


class LibraryMemory(ABC):
    """Steps to a library, in batches; what it finds, as a recall.

    Args:
        every: steps between two writes.
        top: memories recalled.
        step_tokens: most tokens of a step.
        answer_tokens: most tokens of an answer of the model.
        recent: newest steps shown with the memories, where the prompt does not tell them anyway.
    """

    name: ClassVar[str]
    package: ClassVar[str]

    def __init__(
        self,
        services: Services,
        every: int = 1,
        top: int = 5,
        step_tokens: int = 256,
        answer_tokens: int = 512,
        recent: int = 3,
    ) -> None:
        require(self.name, self.package, type(self).declaration.extra)  # type: ignore[attr-defined]
        at_least(self.name, 1, every=every, top=top, step_tokens=step_tokens, answer_tokens=answer_tokens)
        at_least(self.name, 0, recent=recent)
        self.services = services
        self.every, self.top, self.step_tokens, self.recent = every, top, step_tokens, recent
        self.asker = Asker(services, answer_tokens)
        self._pending: list[Step] = []
        self._lines: deque[str] = deque(maxlen=max(1, recent))
        self._failures, self._last_error = 0, ""

    # -- what a library does -----------------------------------------------------------------------------------------

    @abstractmethod
    def open(self) -> Any:
        """The library's memory, empty; called once, when it is first needed."""

    @abstractmethod
    async def add(self, steps: Sequence[Step]) -> None:
        """Let the library make of the steps what it will."""

    @abstractmethod
    async def search(self, text: str, k: int) -> list[tuple[str, float]]:
        """The `k` memories nearest to a text, with their scores, best first."""

    @abstractmethod
    def export(self) -> list[Any]:
        """All that the library holds, as JSON-like values."""

    @abstractmethod
    def load(self, entries: Sequence[Any]) -> None:
        """Put into an empty library what `export` gave."""

    # -- the protocol ------------------------------------------------------------------------------------------------

    @cached_property
    def client(self) -> Any:
        """The library's memory."""
        telemetry_off()
        return self.open()

    def begin_episode(self, task: Task) -> None:
        self._pending = []
        self._lines.clear()

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """The memories nearest to the observation, then the newest steps."""
        found = await self._guarded(self.search(input.text, k or self.top)) or []
        lines = shown_lines(self._lines, self.recent)
        return recalled([(f"- {text}", score) for text, score in found], lines, self.services.llm.module)

    async def store(self, transition: Transition) -> None:
        step = Step.of(transition, self.services, self.step_tokens)
        self._pending.append(step)
        self._lines.append(step.line)
        if not (transition.terminated or transition.truncated) and len(self._pending) >= self.every:
            await self._write()

    async def end_episode(self, trajectory: Trajectory) -> None:
        """What is left is written where a later episode follows."""
        if self.services.carried and self._pending:
            await self._write()

    async def _write(self) -> None:
        steps, self._pending = self._pending, []
        await self._guarded(self.add(steps))

    async def _guarded(self, work: Awaitable[T]) -> T | None:
        """What the library gives; `None`, counted, if it fails.

        Raises:
            Exception: what the model's backend raised meanwhile.
        """
        result = None
        try:
            result = await work
        except Exception as error:
            if self.asker.failed is None:
                self._failures, self._last_error = self._failures + 1, f"{type(error).__name__}: {error}"[:300]
                self.services.count("library")
        self.asker.raise_failed()
        return result

    def metrics(self) -> dict[str, Any]:
        """Memories, and how often the library failed (and how, the last time)."""
        found: dict[str, Any] = {"entries": len(self.export()), "failures": self._failures}
        return found | ({"last_error": self._last_error} if self._last_error else {})

    def snapshot(self) -> bytes:
        """What the library holds, as texts; vectors are made anew when it is restored."""
        waiting = [step.row() for step in self._pending]
        return dump_state([self.export(), waiting, list(self._lines), self._failures, self._last_error])

    def restore(self, blob: bytes) -> None:
        entries, waiting, lines, self._failures, self._last_error = load_state(blob)
        self.__dict__.pop("client", None)
        self.load(entries)
        self._pending = [Step.load(state) for state in waiting]
        self._lines = deque(lines, maxlen=self._lines.maxlen)
