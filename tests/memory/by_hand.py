"""Steps told to a memory as the agent tells them, and what it then recalls; the rest is `one_step`'s."""

from __future__ import annotations

import asyncio
from typing import Any

from agentspec.types import Transition
from tests.memory.one_step import TASK, Asked, episode, seen, services, step

__all__ = ["TASK", "Asked", "episode", "learn", "recall", "seen", "services", "step"]


def learn(memory: Any, *transitions: Transition) -> None:
    """Tell a memory of steps: the clock stands at the step after."""
    for transition in transitions:
        memory.services.clock.step = transition.step + 1
        asyncio.run(memory.store(transition))


def recall(memory: Any, state: str, k: int | None = None) -> list[str]:
    """The texts that a memory recalls at the observation `state`."""
    return [item.text for item in asyncio.run(memory.retrieve(seen(state), k)).items]
