"""The paper's "Base" memory: a rolling buffer of the most recent steps, oldest first, and no model call."""

from __future__ import annotations

from collections import deque

from agentspec.protocols import Services
from agentspec.state import dump_state, load_state
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Experience, Recall, RecallItem, Task, Transition


def describe(transition: Transition) -> str:
    """One line about a step: number, action, what it did, and its reward."""
    return Experience.of(transition).line()


class BaseMemory:
    """The last ``window`` steps of the episode as text.

    Args:
        window: steps kept.
    """

    def __init__(self, services: Services, window: int = 5) -> None:
        if window < 1:
            raise ValueError(f"memory base: window must be at least 1, got {window}")
        self.services = services
        self._lines: deque[str] = deque(maxlen=window)

    def begin_episode(self, task: Task) -> None:
        self._lines.clear()

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        lines = list(self._lines)[-k:] if k else list(self._lines)
        return Recall(tuple(RecallItem(line, source="memory.base", priority=i) for i, line in enumerate(lines)))

    async def store(self, transition: Transition) -> None:
        self._lines.append(describe(transition))

    async def end_episode(self, trajectory: Trajectory) -> None:
        return None

    def snapshot(self) -> bytes:
        return dump_state(list(self._lines))

    def restore(self, blob: bytes) -> None:
        self._lines = deque(load_state(blob), maxlen=self._lines.maxlen)
