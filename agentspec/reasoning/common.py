"""What reasoners without state of their own share."""

from __future__ import annotations

from agentspec.types import Task, Transition


class Stateless:
    """The parts of the reasoning protocol that a method without state of its own leaves empty."""

    def begin_episode(self, task: Task) -> None:
        return None

    async def observe(self, transition: Transition) -> None:
        return None

    def snapshot(self) -> bytes:
        return b""

    def restore(self, blob: bytes) -> None:
        return None
