"""Memory that outlives an episode (`scope: run`): carried per task, kept in files, taken up again.

What an agent carries from episode to episode is the state of its memory and its reflection. A `MemoryBank` holds one
such state per task, since a return says something about a memory only beside other returns of the same task. The bank
of a run lies beside it as `memory.json` (JSON, versioned, written whole or not at all), and any other run, evaluation
or training may start from it (`start_memory`).
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from agentspec.files import write_atomic
from agentspec.registry import SpecError
from agentspec.state import dump_state
from agentspec.types import Task

if TYPE_CHECKING:
    from agentspec.episode import Job, Runner
    from agentspec.spec import AgentSpec
    from agentspec.trajectory import Trajectory

FORMAT = 1
FILE = "memory.json"
KIND = "agentspec memory"
BROKEN = "a memory file with broken content"
GROW = "was it edited, or written by another version? grow the memory again"

Carry = Literal["first", "best"]
"""Whose memory a task carries on: that of its first rollout, or of the one with the highest reward."""


@dataclass(frozen=True)
class MemoryBank:
    """States by task, and what a task without one starts from.

    Args:
        modules: names of the memory and the reflection module whose states these are.
        states: task key -> state of the task's agent, as JSON text.
        latest: key of the task that carried last.
        start: state that tasks without one of their own start from; empty: from nothing.
    """

    modules: tuple[str, str]
    states: Mapping[str, str] = field(default_factory=dict)
    latest: str = ""
    start: str = ""

    @classmethod
    def of_spec(cls, spec: AgentSpec) -> MemoryBank:
        """An empty bank for agents of `spec`."""
        return cls((spec.memory.name, spec.reflection.name))

    def of(self, task: Task) -> bytes | None:
        """What an episode of `task` starts from: the task's own state, else the common start, else nothing."""
        state = self.states.get(task.key, self.start)
        return state.encode() if state else None

    def as_start(self) -> MemoryBank:
        """The bank for tasks it may never have seen: those start from the state that was carried last."""
        return replace(self, start=self.states.get(self.latest, self.start))

    def carried(self, played: Sequence[tuple[str, float | None, bytes | None]], how: Carry = "first") -> MemoryBank:
        """The bank after a round of episodes.

        Args:
            played: (task key, reward, state) of each; without a reward (a failed episode) it carries nothing. A task
                all of whose episodes failed keeps what it had.
            how: which rollout of a task carries on. Rewards are compared within a task only; of equals the first.
        """
        chosen: dict[str, tuple[float, bytes]] = {}
        for key, reward, state in played:
            if reward is None or state is None:
                continue
            if key not in chosen or (how == "best" and reward > chosen[key][0]):
                chosen[key] = (reward, state)
        if not chosen:
            return self
        states = {**self.states, **{key: state.decode() for key, (_, state) in chosen.items()}}
        return replace(self, states=states, latest=list(chosen)[-1])

    def dump(self) -> bytes:
        """The bank as JSON bytes: what a memory file holds."""
        memory, reflection = self.modules
        return dump_state(
            {
                "kind": KIND,
                "format": FORMAT,
                "modules": {"memory": memory, "reflection": reflection},
                "states": self.states,
                "latest": self.latest,
                "start": self.start,
            }
        )

    @classmethod
    def load(cls, blob: bytes) -> MemoryBank:
        """Read what `dump` wrote.

        Raises:
            ValueError: no memory file, or one of a format that this version does not read.
        """
        try:
            data = json.loads(blob)
        except (ValueError, RecursionError):
            data = None
        if not isinstance(data, dict) or data.get("kind") != KIND:
            raise ValueError(
                f"not a memory file; give the {FILE} of a training run, or the .{FILE} beside a file that "
                "`agentspec run --out` wrote for an agent with `scope: run`"
            )
        if data.get("format") != FORMAT:
            raise ValueError(
                f"a memory file of format {data.get('format')}, this version reads {FORMAT}; grow the memory again"
            )
        try:
            modules = str(data["modules"]["memory"]), str(data["modules"]["reflection"])
            states: dict[str, str] = dict(data["states"])
            if not all(isinstance(state, str) for state in states.values()):
                raise TypeError("a state that is no text")
            return cls(modules, states, str(data["latest"]), str(data["start"]))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{BROKEN} ({type(error).__name__}: {error}); {GROW}") from error

    def check(self) -> None:
        """Look into every state, as far as it can be told without its modules.

        Raises:
            ValueError: one of them is not what an agent carries.
        """
        for state in (*self.states.values(), *([self.start] if self.start else [])):
            try:
                time, _, _ = (json.loads(state)[part] for part in ("time", "memory", "reflection"))
                _ = {name: time[name] for name in ("episode", "before", "ids")}
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                raise ValueError(f"{BROKEN} ({type(error).__name__}: {error}); {GROW}") from error


def start_bank(source: str | Path, spec: AgentSpec) -> MemoryBank:
    """What agents of `spec` start from: an empty bank, or that of a memory file or run folder.

    Args:
        source: a file, a folder with a `memory.json`, or empty.
        spec: the agent; its memory and reflection must be those that the file was written by.

    Raises:
        SpecError: no such file, a file of other modules, or an agent that carries nothing (`scope: episode`).
    """
    if not source:
        return MemoryBank.of_spec(spec)
    bank = read_bank(source, "start_memory: ")
    if spec.scope != "run":
        raise SpecError(
            f"start_memory {str(source)!r}: the agent ({spec.label}) has `scope: {spec.scope}`, so every episode "
            "starts empty; set `scope: run`"
        )
    wanted = MemoryBank.of_spec(spec).modules
    if bank.modules != wanted:
        raise SpecError(
            f"start_memory {source} holds the state of memory and reflection {bank.modules}, the agent has {wanted}; "
            "give the agent the same modules"
        )
    return bank.as_start()


def read_bank(source: str | Path, what: str = "") -> MemoryBank:
    """The bank of a memory file, or of a run folder that holds one; `what` begins the messages.

    Raises:
        SpecError: there is no such file, or it is no memory file.
    """
    path = Path(source)
    path = path / FILE if path.is_dir() else path
    if not path.is_file():
        raise SpecError(f"{what}there is no {path}; give a memory file, or the folder of a run that wrote one")
    try:
        bank = MemoryBank.load(path.read_bytes())
        bank.check()
    except ValueError as error:
        raise SpecError(f"{what}{path}: {error}") from error
    return bank


def save_bank(path: str | Path, bank: MemoryBank) -> None:
    """Write a memory file, whole or not at all."""
    write_atomic(path, bank.dump())


async def play_in_order(
    runner: Runner, jobs: Sequence[Job], start: MemoryBank | None = None
) -> tuple[list[Trajectory], MemoryBank]:
    """One episode after the other, each starting from the memory that the last unfailed one left.

    Args:
        runner: of an agent with `scope: run`.
        jobs: in order.
        start: where the first episode starts.

    Returns:
        the episodes in order, and the bank in which each task has the memory its episode left.
    """
    bank = start or MemoryBank.of_spec(runner.spec)
    played: list[Trajectory] = []
    memory = bank.of(jobs[0].task) if jobs else None
    tell = runner.progress(len(jobs)) if runner.progress else None
    alone = replace(runner, progress=None)
    for job in jobs:
        [trajectory] = await alone.run_async([replace(job, memory_state=memory)])
        played.append(trajectory)
        if tell:
            tell(trajectory)
        if trajectory.scorable:
            memory = trajectory.memory_state
            bank = bank.carried([(job.task.key, 0.0, memory)])
    return played, bank


def run_in_order(
    runner: Runner, jobs: Sequence[Job], start: MemoryBank | None = None
) -> tuple[list[Trajectory], MemoryBank]:
    """As `play_in_order`, outside a running loop."""
    return asyncio.run(play_in_order(runner, jobs, start))
