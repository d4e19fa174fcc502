"""Cells of the matrix: one policy under one scaffold, its episodes and what they are called in a store."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from agentspec.actions import suggest
from agentspec.carry import MemoryBank, start_bank
from agentspec.episode import Job
from agentspec.files import digest, file_digest, json_line
from agentspec.llm.pricing import Prices
from agentspec.parameters import check_types
from agentspec.policies import Policy, weighed
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.trajectory import versions
from agentspec.types import Sampling, Task
from eval.limits import Limits
from eval.store import Record, Store

GREEDY: Mapping[str, Any] = {"temperature": 0.0}

CellName = tuple[str, str, str]
"""(policy, training run, scaffold)."""


@dataclass(frozen=True)
class Settings:
    """How an evaluation plays.

    Args:
        rollouts: episodes per task (they differ in the agent's own draws; averaged before intervals are taken).
        seed: seed of the evaluation; the same for all policies.
        sampling: fields of `agentspec.types.Sampling` that replace those of every scaffold; `None`: greedy.
        concurrency: most episodes at once (`None`: all of a policy's); with `--executor ray`, per worker.
        timeout_s: limit of one environment call, in seconds.
        max_steps: most steps of an episode, on top of the environment's own limit.
        prices: dollars per token, by model name.
        trajectories: keep every episode under `trajectories/`.
        start_memory: for scaffolds with `scope: run`, a memory file or the folder of a run that wrote one: every
            chain of episodes starts from it. A mapping gives policies, by name, starts of their own; others have none.
        retry_failed: play episodes again that failed.
        limits: what an episode and a cell may take.
    """

    rollouts: int = 1
    seed: int = 0
    sampling: Mapping[str, Any] | None = None
    concurrency: int | None = None
    timeout_s: float | None = 60.0
    max_steps: int | None = None
    prices: Prices = field(default_factory=Prices)
    trajectories: bool = False
    start_memory: str | Mapping[str, str] = ""
    retry_failed: bool = False
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        for name, least in (("rollouts", 1), ("concurrency", 1), ("max_steps", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise SpecError(f"{name} must be at least {least}, got {value}")
        if self.timeout_s is not None and not self.timeout_s > 0:
            raise SpecError(f"timeout_s must be above 0, got {self.timeout_s}")
        names = Sampling.__dataclass_fields__
        for name in self.sampling or ():
            if name not in names:
                raise SpecError(f"unknown key {name!r} in sampling{suggest(str(name), names)}")
        check_types("sampling", Sampling, self.sampling or {})

    def start_of(self, policy: Policy, spec: AgentSpec) -> MemoryBank:
        """The memory that chains of episodes start from: nothing where nothing outlives an episode, or learns.

        Raises:
            SpecError: no such file, or one of other modules than the scaffold's.
        """
        given = self.start_memory
        source = given if isinstance(given, str) else given.get(policy.name, "")
        return start_bank(source if spec.scope == "run" and not policy.scripted else "", spec)

    def apply(self, spec: AgentSpec) -> AgentSpec:
        """The scaffold with the evaluation's sampling."""
        given = GREEDY if self.sampling is None else self.sampling
        plain: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in given.items()
        }
        return replace(spec, sampling=replace(spec.sampling, **plain))


@dataclass(frozen=True)
class Planned:
    """An episode of a cell: what to play, in which labelled set of tasks."""

    job: Job
    tasks: str


@dataclass(frozen=True)
class Cell:
    """One policy under one scaffold.

    Args:
        configuration: digest of everything that is common to its episodes and decides what they are.
        chains: episodes in order. With `scope: run` memory runs through a chain; else each chain is one episode.
        start: what each chain starts from.
    """

    policy: Policy
    scaffold: str
    spec: AgentSpec
    configuration: str
    chains: tuple[tuple[Planned, ...], ...]
    start: MemoryBank

    @property
    def name(self) -> CellName:
        """Policy, training run and scaffold."""
        return self.policy.name, self.policy.run, self.scaffold

    @property
    def carries(self) -> bool:
        """Whether memory runs from episode to episode."""
        return self.spec.scope == "run"

    def key(self, job: Job, memory: bytes | None) -> str:
        """What an episode of this cell is called in a store: also by the memory that it starts from."""
        parts = [self.configuration, job.task.key, files_of(job.task), job.rollout, job.run_seed]
        return digest(json_line({"episode": parts, "memory": digest(memory) if memory else ""}))

    def first_memory(self, chain: Sequence[Planned]) -> bytes | None:
        """What the first episode of a chain starts from."""
        return self.start.of(chain[0].job.task) if self.carries else None

    def walk(self, store: Store, chain: Sequence[Planned]) -> Iterator[tuple[Planned, Record | None, bytes | None]]:
        """The chain's episodes with what the store has of each, up to the first that it has not.

        Yields:
            the episode, its record or `None`, and the memory that it starts from.
        """
        memory = self.first_memory(chain)
        for planned in chain:
            record = store.get(self.key(planned.job, memory))
            yield planned, record, memory
            if record is None:
                return
            try:
                memory = self.after(store, record, memory)
            except ValueError:  # its state is gone: what comes after cannot be found, and playing will say why
                yield from ((later, None, None) for later in chain[chain.index(planned) + 1 :][:1])
                return

    def after(self, store: Store, record: Record, memory: bytes | None) -> bytes | None:
        """The memory after an episode: a failed one leaves the memory that it started from."""
        if not self.carries or record["episode"]["status"] != "completed":
            return memory
        return store.state(record)


def plan_cell(
    policy: Policy, scaffold: str, spec: AgentSpec, sets: Mapping[str, Sequence[Task]], settings: Settings, store: Store
) -> Cell:
    """All episodes of one cell."""
    spec = settings.apply(policy.apply(spec))
    data = spec.to_data()
    if roles := data.get("roles"):
        data["roles"] = {pattern: weighed(role) for pattern, role in roles.items()}
    if isinstance(spec.embedder, Mapping):
        data["embedder"] = weighed(spec.embedder)
    described = {"spec": data, "policy": policy.identity(), "max_steps": settings.max_steps, "versions": versions()}
    if spec.budget.cost is not None:  # prices say when such an episode is over
        described["prices"] = {name: asdict(price) for name, price in settings.prices.table.items()}
    configuration = store.describe(described)
    chains: list[tuple[Planned, ...]] = []
    for rollout in range(settings.rollouts):
        for label, members in sets.items():
            episodes = tuple(Planned(Job(task, rollout, settings.seed), label) for task in members)
            chains += [episodes] if spec.scope == "run" else [(episode,) for episode in episodes]
    return Cell(policy, scaffold, spec, configuration, tuple(chains), settings.start_of(policy, spec))


def files_of(task: Task) -> list[str]:
    """Digests of the files that a task's options name: a changed file is another task."""
    from pathlib import Path

    paths = [Path(value) for value in task.options.values() if isinstance(value, str) and len(value) < 4096]
    return [file_digest(path) for path in paths if path.is_file()]
