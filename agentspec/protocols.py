"""What a module must offer, and what it is given.

A module is built once per episode with its `Services` and its own keyword parameters. Everything it may use from
outside comes with the services, so that a rollout is reproducible: no module reads the wall clock, global randomness
or uuids. Methods that may call the model are ``async``. State that outlives an episode (``scope: run``) travels as the
``snapshot()`` of one instance restored into the next, never as a shared object.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from agentspec.services import Answer, Services, StepClock, Time
from agentspec.types import AgentInput, Decision, Recall, Task, Transition

if TYPE_CHECKING:
    from agentspec.trajectory import Trajectory

__all__ = [
    "Answer",
    "Embedder",
    "Measured",
    "Memory",
    "Perception",
    "Reasoning",
    "Reflection",
    "Services",
    "Simulated",
    "Simulator",
    "Stateful",
    "StepClock",
    "Time",
]


class Embedder(Protocol):
    """Text -> unit vectors of dimension ``dim``, float32, shape (len(texts), dim)."""

    dim: int

    def embed(self, texts: list[str]) -> NDArray[np.float32]: ...


@dataclass(frozen=True)
class Simulated:
    """What one simulated step led to.

    Args:
        input: u_t of the state that was reached, as perception shows it.
        reward: reward of the step.
        ended: whether the episode would be over (terminated or truncated).
        info: the environment's report of the step, without what already stands in ``input``.
    """

    input: AgentInput
    reward: float
    ended: bool
    info: Mapping[str, Any] = field(default_factory=dict)


class Simulator(Protocol):
    """The episode's own environment, for search: try steps, then go back.

    Whoever uses it returns the environment to the exact state it found (``snapshot`` first, ``restore`` last).
    """

    async def snapshot(self) -> bytes: ...

    async def restore(self, blob: bytes) -> None: ...

    async def step(self, action: str) -> Simulated: ...


class Perception(Protocol):
    """Observation -> u_t."""

    def perceive(self, task: Task, observation: Mapping[str, Any], info: Mapping[str, Any]) -> AgentInput: ...


class Stateful(Protocol):
    """Exact state as bytes, for search, groups that start alike, and resume."""

    def snapshot(self) -> bytes: ...

    def restore(self, blob: bytes) -> None: ...


class Memory(Stateful, Protocol):
    """What is remembered, within an episode or across episodes.

    `store` is told of every step, the last one included, and what it asks the model belongs to the step after.
    `end_episode` may write what the next episodes shall know.
    """

    def begin_episode(self, task: Task) -> None: ...

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall: ...

    async def store(self, transition: Transition) -> None: ...

    async def end_episode(self, trajectory: Trajectory) -> None: ...


class Reasoning(Stateful, Protocol):
    """u_t, m_t -> r_t."""

    def begin_episode(self, task: Task) -> None: ...

    async def decide(self, input: AgentInput, recall: Recall) -> Decision: ...

    async def observe(self, transition: Transition) -> None: ...


class Reflection(Stateful, Protocol):
    """Lessons before the decision, revision after it, insight at the episode's end."""

    def begin_episode(self, task: Task) -> None: ...

    async def lessons(self, input: AgentInput) -> Recall: ...

    async def revise(self, input: AgentInput, recall: Recall, decision: Decision) -> Decision: ...

    async def end_episode(self, trajectory: Trajectory) -> None: ...


@runtime_checkable
class Described(Protocol):
    """A memory (or reflector) that says in text what its state holds, for `agentspec view --memory`."""

    def describe(self) -> str: ...


@runtime_checkable
class Measured(Protocol):
    """A module that has figures of its own to add to the trajectory's metrics (JSON-like)."""

    def metrics(self) -> Mapping[str, Any]: ...
