"""The paper's "Base" memory: a rolling buffer of the most recent steps, oldest first, and no model call."""

from __future__ import annotations

from collections import deque

from agentspec.declaration import Declaration
from agentspec.protocols import Services
from agentspec.state import dump_state, load_state
from agentspec.tokens import excerpt, news
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Experience, Recall, RecallItem, Task, Transition


def describe(transition: Transition) -> str:
    """One line about a step: number, action, what it did, and its reward."""
    return Experience.of(transition).line()


class BaseMemory:
    """The last `window` steps of the episode as text: action, outcome, and what was seen.

    In a conversation nothing is told twice (`agentspec.prompting`): of the steps that it still holds only failures are
    shown whose reason no observation gave.

    Args:
        window: steps kept.
        observation_tokens: most tokens of each step's observation in the `snapshot` layout, of what is new in it.
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
        self._before = ["", ""]  # the observation that was told last, and what came of the action then
        self._steps: deque[tuple[str, str]] = deque(maxlen=window)
        """What is told of a step, and as which kind of thing: a `step`, or a `failure`."""

    def begin_episode(self, task: Task) -> None:
        self._steps.clear()
        self._before = ["", ""]

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        steps = list(self._steps)[-k:] if k else self._steps
        items = [RecallItem(line, 0.0, kind, "memory.base", i) for i, (line, kind) in enumerate(steps)]
        return Recall(tuple(items))

    async def store(self, transition: Transition) -> None:
        seen = Experience.of(transition)
        line = seen.line()
        if self.observation_tokens and self.services.context.layout == "snapshot":
            fresh = news(transition.input.text, *self._before)
            self._before = [transition.input.text, seen.feedback]
            if fresh:
                line += f"\n   before it: {excerpt(fresh, self.observation_tokens, self.services.llm.count_tokens)}"
        self._steps.append((line, "step" if seen.ok else "failure"))

    async def end_episode(self, trajectory: Trajectory) -> None:
        return None

    def snapshot(self) -> bytes:
        return dump_state([self._before, [list(step) for step in self._steps]])

    def restore(self, blob: bytes) -> None:
        self._before, steps = load_state(blob)
        self._steps = deque(((line, kind) for line, kind in steps), maxlen=self._steps.maxlen)
