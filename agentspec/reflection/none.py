"""No reflection: every decision stands."""

from __future__ import annotations

from agentspec.declaration import Declaration
from agentspec.protocols import Services
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Decision, Recall, Task


class NoReflection:
    """The identity."""

    declaration = Declaration(
        "keeps every decision as it is",
    )

    def __init__(self, services: Services) -> None:
        self.services = services

    def begin_episode(self, task: Task) -> None:
        return None

    async def lessons(self, input: AgentInput) -> Recall:
        return Recall()

    async def revise(self, input: AgentInput, recall: Recall, decision: Decision) -> Decision:
        return decision

    async def end_episode(self, trajectory: Trajectory) -> None:
        return None

    def snapshot(self) -> bytes:
        return b""

    def restore(self, blob: bytes) -> None:
        return None
