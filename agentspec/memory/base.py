"""The paper's "Base" memory: a rolling buffer of the most recent steps, oldest first, and no model call."""

from __future__ import annotations

from collections import deque

from agentspec.declaration import Declaration
from agentspec.protocols import Services
from agentspec.state import dump_state, load_state
from agentspec.tokens import excerpt
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Experience, Recall, RecallItem, Task, Transition


def describe(transition: Transition) -> str:
    """One line about a step: number, action, what it did, and its reward."""
    return Experience.of(transition).line()


class BaseMemory:
    """The last `window` steps of the episode as text: action, outcome, and what was seen.

    Args:
        window: steps kept.
        observation_tokens: most tokens of each step's observation; in a conversation, which holds the observations
            themselves, none are repeated.
    """

    declaration = Declaration(
        "rolling buffer of the most recent steps",
        aliases=("simple",),
    )

    def __init__(self, services: Services, window: int = 5, observation_tokens: int = 32) -> None:
        if window < 1:
            raise ValueError(f"memory base: window must be at least 1, got {window}")
        self.services = services
        self.observation_tokens = observation_tokens
        self._lines: deque[str] = deque(maxlen=window)

    def begin_episode(self, task: Task) -> None:
        self._lines.clear()

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        lines = list(self._lines)[-k:] if k else list(self._lines)
        return Recall(tuple(RecallItem(line, source="memory.base", priority=i) for i, line in enumerate(lines)))

    async def store(self, transition: Transition) -> None:
        line = describe(transition)
        if self.observation_tokens and self.services.context.layout == "snapshot":
            count = self.services.llm.count_tokens
            line += f"\n   seen: {excerpt(transition.input.text, self.observation_tokens, count)}"
        self._lines.append(line)

    async def end_episode(self, trajectory: Trajectory) -> None:
        return None

    def snapshot(self) -> bytes:
        return dump_state(list(self._lines))

    def restore(self, blob: bytes) -> None:
        self._lines = deque(load_state(blob), maxlen=self._lines.maxlen)
