"""G rollouts of each task, run through the agent, all at once.

The trainer gives its generation batch (task rows, each repeated G times by TRL's sampler); what comes back is one
`trainers.credit.ScoredEpisode` per row, in order: the trajectory and what it earned, computed once. A rollout
that failed is among them, without a score.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from torch import nn

from agentspec.carry import MemoryBank
from agentspec.episode import Job, Runner
from agentspec.llm.base import LLM
from agentspec.llm.recorder import derive_seed
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from rewards import RewardSet, Score
from trainers.credit import ScoredEpisode


def task_rows(tasks: Sequence[Task]) -> list[dict[str, Any]]:
    """Dataset rows for TRL: a prompt for its logs, and the task as JSON."""
    return [
        {"prompt": [{"role": "user", "content": f"{t.env} seed {t.seed}"}], "task": json.dumps(asdict(t))}
        for t in tasks
    ]


def task_of(row: dict[str, Any]) -> Task:
    """The task of a dataset row."""
    return Task(**json.loads(row["task"]))


def rollout_jobs(
    rows: Sequence[dict[str, Any]],
    *,
    seed: int,
    round: int,
    first: int = 0,
    group: int = 1,
    memory: bytes | None = None,
) -> list[Job]:
    """One job per row of this rank's part of the generation batch.

    Args:
        seed, round: of the run, and the number of the generation round: another one samples anew.
        first: global index of the first row, so that rollouts of a group that spans ranks differ.
        group: rollouts per task.
        memory: the run's `agentspec.carry.MemoryBank` as bytes (with `scope: run`): all rollouts of a task start
            from that task's state.
    """
    run_seed = derive_seed(seed, round)
    tasks = [task_of(row) for row in rows]
    states = starting_states(tasks, memory)
    return [
        Job(t, (first + i) % group, run_seed, state) for i, (t, state) in enumerate(zip(tasks, states, strict=True))
    ]


def starting_states(tasks: Sequence[Task], memory: bytes | None, *, unseen: bool = False) -> list[bytes | None]:
    """What an episode of each task starts from, out of a run's memory.

    Args:
        memory: a `MemoryBank` as bytes; `None`: nothing is carried.
        unseen: tasks that the run does not train on: without a state of their own they start from the latest.
    """
    if memory is None:
        return [None] * len(tasks)
    bank = MemoryBank.load(memory)
    return [(bank.as_start() if unseen else bank).of(task) for task in tasks]


def collect(runner: Runner, jobs: Sequence[Job], rewards: RewardSet, *, retries: int = 0) -> list[ScoredEpisode]:
    """Run the jobs and score what they gave; every failure is an episode too.

    A failed job is run again up to `retries` times, each time with a seed of its own; what still fails stays failed.
    An episode is a failure too if its environment reported NaN or infinity and cannot be scored.
    """
    episodes = [_scored(t, rewards) for t in runner.run(jobs)]
    for attempt in range(1, retries + 1):
        failed = [i for i, e in enumerate(episodes) if e.score is None]
        if not failed:
            break
        again = [replace(jobs[i], run_seed=derive_seed(jobs[i].run_seed, "retry", attempt)) for i in failed]
        for i, trajectory in zip(failed, runner.run(again), strict=True):
            episodes[i] = _scored(trajectory, rewards)
    return episodes


def _scored(trajectory: Trajectory, rewards: RewardSet) -> ScoredEpisode:
    """The episode and what it earned; failed if what its environment reported makes its reward no number.

    Raises:
        ValueError: a reward that this environment cannot be scored with: every episode would fail.
    """
    score: Score | None = None
    try:
        score = rewards.score(trajectory)
    except ValueError as error:
        reported = (value for t in trajectory.transitions for value in t.info.values())
        if all(math.isfinite(v) for v in reported if isinstance(v, float)):
            raise
        trajectory = replace(trajectory, status="failed", error=f"not finite: {error}")
    return ScoredEpisode(trajectory, score)


def local_llm(
    model: nn.Module, tokenizer: Any, batching: Any = "auto", adapters: Mapping[str, str] | None = None
) -> LLM:
    """The local backend over the live policy; `adapters`: which of its adapters answers which calls."""
    from agentspec.llm.local import LocalLLM

    return LocalLLM(model, tokenizer, name="policy", batching=batching, adapters=adapters)
