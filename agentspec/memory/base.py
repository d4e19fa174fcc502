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

    In a conversation nothing is told twice: of the steps that it still holds only failures stand here whose reason no
    observation gave.

    Args:
        window: steps kept.
        observation_tokens: most tokens of each step's observation in the `snapshot` layout.
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
        self._steps: deque[tuple[int, str, str]] = deque(maxlen=window)
        """Number of a step, what is told of it, and why it failed (empty: it did not)."""

    def begin_episode(self, task: Task) -> None:
        self._steps.clear()

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        context = self.services.context
        told = self.services.clock.step - context.told
        said = [input.text, *(m.text for m in context.messages)] if context.told else []
        lines = [
            line
            for step, line, failure in self._steps
            if step < told or (failure and not any(failure in text for text in said))
        ]
        lines = lines[-k:] if k else lines
        return Recall(tuple(RecallItem(line, source="memory.base", priority=i) for i, line in enumerate(lines)))

    async def store(self, transition: Transition) -> None:
        seen = Experience.of(transition)
        line = seen.line()
        if self.observation_tokens and self.services.context.layout == "snapshot":
            count = self.services.llm.count_tokens
            line += f"\n   seen: {excerpt(transition.input.text, self.observation_tokens, count)}"
        self._steps.append((transition.step, line, "" if seen.ok else seen.feedback))

    async def end_episode(self, trajectory: Trajectory) -> None:
        return None

    def snapshot(self) -> bytes:
        return dump_state([list(step) for step in self._steps])

    def restore(self, blob: bytes) -> None:
        steps = load_state(blob)
        self._steps = deque(((number, line, failure) for number, line, failure in steps), maxlen=self._steps.maxlen)
