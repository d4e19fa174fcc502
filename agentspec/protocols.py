"""What a module must offer, and what it is given.

A module is built once per episode with its :class:`Services` and its own keyword parameters. Everything it may use from
outside comes with the services, so that a rollout is reproducible: no module reads the wall clock, global randomness
or uuids. Methods that may call the model are ``async``. State that outlives an episode (``scope: run``) travels as the
``snapshot()`` of one instance restored into the next, never as a shared object.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from agentspec.types import AgentInput, Decision, Recall, Task, Transition

if TYPE_CHECKING:
    from agentspec.context import Context
    from agentspec.llm.recorder import ModuleLLM
    from agentspec.trajectory import Trajectory


class Embedder(Protocol):
    """Text -> unit vectors of dimension ``dim``, float32, shape (len(texts), dim)."""

    dim: int

    def embed(self, texts: list[str]) -> NDArray[np.float32]: ...


class StepClock:
    """Time in environment steps of the current episode."""

    def __init__(self) -> None:
        self.step = 0

    def __call__(self) -> int:
        return self.step


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


@dataclass
class Services:
    """What the scaffold injects into a module.

    Args:
        llm: the metered model, bound to the module's name.
        context: the running conversation of the episode (shared by the modules of one agent).
        clock: environment steps since the episode began.
        rng: the module's own generator, seeded by run, task, rollout and module.
        embedder: text embeddings, or ``None`` where the spec names no embedder.
        new_id: counter for ids, unique within the module.
        simulator: the environment for search, or ``None`` where it has no snapshots.
    """

    llm: ModuleLLM
    context: Context
    clock: Callable[[], int]
    rng: random.Random
    embedder: Embedder | None = None
    new_id: Callable[[], int] = field(default_factory=lambda: itertools.count().__next__)
    simulator: Simulator | None = None


class Perception(Protocol):
    """Observation -> u_t."""

    def perceive(self, task: Task, observation: Mapping[str, Any], info: Mapping[str, Any]) -> AgentInput: ...


class Stateful(Protocol):
    """Exact state as bytes, for search, groups that start alike, and resume."""

    def snapshot(self) -> bytes: ...

    def restore(self, blob: bytes) -> None: ...


class Memory(Stateful, Protocol):
    """What is remembered, within an episode or across episodes."""

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
class Measured(Protocol):
    """A module that has figures of its own to add to the trajectory's metrics (JSON-like)."""

    def metrics(self) -> Mapping[str, Any]: ...
