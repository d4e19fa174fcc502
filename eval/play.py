"""Playing the cells of one policy: chains of episodes side by side, each finished one in the store before the next.

Who plays an episode is a `Player`: here one model in this process (`LocalPlayer`), in `eval.ray_player` copies of it on
other processes and machines. What is played, in which order, and what is kept is the same for all.
"""

from __future__ import annotations

import asyncio
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from agentspec.episode import Job, MakeEnv, Runner, make_env
from agentspec.files import write_atomic
from agentspec.llm.base import LLM
from agentspec.metrics import episode_row
from agentspec.policies import Policy
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from eval.cells import Cell, Planned, Settings
from eval.naming import slug
from eval.repricing import TAKEN, usage_of
from eval.store import Record, Store

MakeLLM = Callable[[Policy], LLM | None]
Told = Callable[[Cell, Planned, Record], None]


@dataclass(frozen=True)
class Played:
    """A finished episode as it travels between processes: its row, what memory it left, how long it took, its JSON, and
    what its calls used of which model (`eval.repricing.usage_of`)."""

    episode: dict[str, Any]
    state: bytes | None
    wall_s: float
    trajectory: str = ""
    usage: list[dict[str, Any]] = field(default_factory=list)


class Player(Protocol):
    """Somebody who plays the episodes of one policy."""

    async def play(self, cell: Cell, job: Job) -> Played:
        """Play one episode; many may be asked for at once."""
        ...


class LocalPlayer:
    """Plays in this process: all cells of a policy share its model."""

    def __init__(self, llm: LLM | None, settings: Settings, make_env: MakeEnv = make_env) -> None:
        self.llm, self.settings, self.make_env = llm, settings, make_env

    async def play(self, cell: Cell, job: Job) -> Played:
        """As the protocol says; an episode over its time limit is a failed one."""
        began = time.monotonic()
        settings = self.settings
        runner = Runner(
            cell.spec,
            self.llm,
            make_env=self.make_env,
            timeout_s=settings.timeout_s,
            max_steps=settings.max_steps,
            prices=settings.prices,
            policy=cell.policy.name,
        )
        most = settings.limits.episode_s
        try:
            [trajectory] = await asyncio.wait_for(runner.run_async([job]), most)
        except TimeoutError:
            trajectory = _unfinished(cell, job, f"the episode took longer than {most:g} s")
        text = trajectory.to_json() if settings.trajectories else ""
        used, took = usage_of(trajectory.calls), time.monotonic() - began
        return Played(episode_of(trajectory), trajectory.memory_state, took, text, used)


def _unfinished(cell: Cell, job: Job, why: str) -> Trajectory:
    return Trajectory(
        task=job.task,
        spec=cell.spec.to_data(),
        rollout=job.rollout,
        seed=job.seed,
        policy=cell.policy.name,
        transitions=(),
        calls=(),
        metrics={"ended": "time"},
        status="failed",
        error=why,
    )


def episode_of(trajectory: Trajectory) -> dict[str, Any]:
    """The row of an episode, with what each module's calls took: `modules: {name: {calls, input_tokens, ...}}`."""
    modules: dict[str, dict[str, float]] = {}
    for call in trajectory.calls:
        sums = modules.setdefault(call.tag.module, dict.fromkeys(TAKEN, 0.0))
        usage = call.usage
        taken = (1, usage.input_tokens, usage.output_tokens, usage.cost, call.latency_s)
        for name, value in zip(sums, taken, strict=True):
            sums[name] += value
    return episode_row(trajectory) | {"modules": modules}


@dataclass
class Play:
    """Plays what is missing of a policy's cells.

    Args:
        store: open for writing.
        told: is told of every episode that was added.
        fresh: keys that may not be taken from the store although they are there: failures to be tried again.
        under_way: keys that are being played, each locked: cells that ask for the same episode play it once.
    """

    store: Store
    settings: Settings
    told: Told
    fresh: set[str]
    under_way: defaultdict[str, asyncio.Lock] = field(default_factory=lambda: defaultdict(asyncio.Lock))

    async def cell(self, cell: Cell, player: Player, gate: AbstractAsyncContextManager[Any]) -> None:
        """All chains of a cell, as many episodes at once as `gate` lets in; returns when none can go on."""
        records = _cell_records(cell, self.store)
        async with asyncio.TaskGroup() as group:
            for chain in cell.chains:
                group.create_task(self._chain(cell, chain, player, gate, records))

    async def _chain(
        self,
        cell: Cell,
        chain: Sequence[Planned],
        player: Player,
        gate: AbstractAsyncContextManager[Any],
        records: list[Record],
    ) -> None:
        memory = cell.first_memory(chain)
        for planned in chain:
            key = cell.key(planned.job, memory)
            record = self._kept(key)
            if record is None:
                async with self.under_way[key]:
                    if (record := self._kept(key)) is None:
                        async with gate:
                            if self.settings.limits.spent(records):
                                return
                            played = await player.play(cell, replace(planned.job, memory_state=memory))
                        record = self._keep(cell, planned, key, played)
                records.append(record)
                self.told(cell, planned, record)
            memory = cell.after(self.store, record, memory)

    def _kept(self, key: str) -> Record | None:
        return None if key in self.fresh else self.store.get(key)

    def _keep(self, cell: Cell, planned: Planned, key: str, played: Played) -> Record:
        record: dict[str, Any] = {
            "configuration": cell.configuration,
            "episode": played.episode,
            "usage": played.usage,
            "wall_s": round(played.wall_s, 3),
        }
        if played.trajectory:
            record["trajectory"] = _keep_trajectory(self.store, cell, planned.job.task, key, played.trajectory)
        self.fresh.discard(key)
        completed = played.episode["status"] == "completed"
        return self.store.add(key, record, played.state if cell.carries and completed else None)


def _keep_trajectory(store: Store, cell: Cell, task: Task, key: str, text: str) -> str:
    """Write an episode; returns its path in the store's folder, in which names are for people and the key is unique."""
    run = f"-{slug(cell.policy.run)}" if cell.policy.run else ""
    path = f"trajectories/{slug(cell.policy.name)}{run}/{slug(cell.scaffold)}/{task.key}-{key[:12]}.jsonl"
    write_atomic(store.folder / path, text + "\n")
    return path


def _cell_records(cell: Cell, store: Store) -> list[Record]:
    found = (record for chain in cell.chains for _, record, _ in cell.walk(store, chain))
    return [record for record in found if record is not None]
