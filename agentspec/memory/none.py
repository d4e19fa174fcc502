"""No memory: the baseline that shows what a memory is worth."""

from __future__ import annotations

from agentspec.declaration import Declaration
from agentspec.protocols import Services
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, Task, Transition


class NoMemory:
    """Stores nothing and recalls nothing."""

    declaration = Declaration(
        "remembers nothing",
    )

    def __init__(self, services: Services) -> None:
        self.services = services

    def begin_episode(self, task: Task) -> None:
        return None

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        return Recall()

    async def store(self, transition: Transition) -> None:
        return None

    async def end_episode(self, trajectory: Trajectory) -> None:
        return None

    def snapshot(self) -> bytes:
        return b""

    def restore(self, blob: bytes) -> None:
        return None
