"""The episode's environment as a simulator: search tries steps in it and goes back.

An environment offers this by two methods of its own (on ``env.unwrapped``): ``snapshot() -> bytes`` and
``restore(blob)``, exact in everything that decides what happens next, random generators included. Steps are taken
beneath gymnasium's wrappers, so that a wrapper's own counters (a time limit, say) never see them. All calls run in the
episode's worker, in order and under its time limit, like those of the episode itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from agentspec.protocols import Perception, Simulated
from agentspec.types import Task

T = TypeVar("T")

OBJECTS_IN_INFO = ("instruction", "action_schema", "state", "metrics")
"""Entries of ``info`` that a transition does not repeat: they stand in the agent's input or in the metrics."""


class EnvironmentFailedError(RuntimeError):
    """An environment crashed, hung or returned what no reward can be computed from."""


class Worker(Protocol):
    """Runs one environment's calls in order (see :class:`agentspec.episode.EnvWorker`)."""

    async def call(self, what: str, function: Callable[[], T]) -> T: ...


class EpisodeSimulator:
    """A :class:`~agentspec.protocols.Simulator` over the environment of one episode."""

    def __init__(self, env: Any, worker: Worker, task: Task, perception: Perception) -> None:
        self._env = env
        self._worker = worker
        self._task = task
        self._perception = perception

    async def snapshot(self) -> bytes:
        """The environment's exact state."""
        blob: bytes = await self._worker.call("snapshot", self._env.snapshot)
        return blob

    async def restore(self, blob: bytes) -> None:
        """Return to a snapshot."""
        await self._worker.call("restore", lambda: self._env.restore(blob))

    async def step(self, action: str) -> Simulated:
        """Act, and perceive what came of it.

        Raises:
            EnvironmentFailedError: the environment crashed, hung, or paid a reward that is not finite.
        """
        observation, reward, terminated, truncated, info = await self._worker.call(
            "simulated step", lambda: self._env.step(action)
        )
        if not math.isfinite(float(reward)):
            raise EnvironmentFailedError(
                f"simulated step returned reward {reward} for action {action!r}; rewards must be finite"
            )
        seen = self._perception.perceive(self._task, observation, info)
        report = {k: v for k, v in info.items() if k not in OBJECTS_IN_INFO}
        return Simulated(seen, float(reward), bool(terminated or truncated), report)


def simulator_of(env: Any, worker: Worker, task: Task, perception: Perception) -> EpisodeSimulator | None:
    """The simulator of ``env``, or ``None`` if it cannot snapshot and restore."""
    if not can_simulate(env):
        return None
    return EpisodeSimulator(getattr(env, "unwrapped", env), worker, task, perception)


def can_simulate(env: Any) -> bool:
    """Whether ``env`` can snapshot and restore."""
    world = getattr(env, "unwrapped", env)
    return callable(getattr(world, "snapshot", None)) and callable(getattr(world, "restore", None))
