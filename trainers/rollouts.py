"""G rollouts of each task, run through the agent, all at once.

The trainer hands over its generation batch (task rows, each repeated G times by TRL's sampler); what comes back is one
:class:`~trainers.credit.ScoredEpisode` per row, in order: the trajectory and what it earned, computed once. A rollout
that failed is among them, without a score.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from torch import nn

from agentspec.episode import Job, Runner
from agentspec.llm.base import LLM
from agentspec.llm.recorder import derive_seed
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from rewards import RewardSet, Score
from trainers.credit import ScoredEpisode

TEST_SEEDS = 20_000
"""Held-out tasks start at this seed; training tasks stay below 10,000 (validation lies between)."""


def make_tasks(env: str, options: dict[str, Any], count: int, *, split: str = "train", first: int = 0) -> list[Task]:
    """``count`` tasks of one environment with consecutive seeds.

    Raises:
        ValueError: training seeds that reach into the held-out range.
    """
    base = {"train": 0, "validation": 10_000, "test": TEST_SEEDS}[split] + first
    if split == "train" and base + count > 10_000:
        raise ValueError(f"training seeds {base}..{base + count - 1} reach the held-out range; use fewer than 10,000")
    return [Task(env, base + i, options, split) for i in range(count)]


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
    """One job per row.

    Args:
        rows: this rank's part of the generation batch.
        seed: seed of the run.
        round: number of the generation round; another round samples anew.
        first: global index of the first row, so that rollouts of a group that spans ranks differ.
        group: rollouts per task.
        memory: state that memories with ``scope: run`` start from; all rollouts of a round start alike.
    """
    run_seed = derive_seed(seed, round)
    return [Job(task_of(row), (first + i) % group, run_seed, memory) for i, row in enumerate(rows)]


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


def local_llm(model: nn.Module, tokenizer: Any, batching: Any = "auto") -> LLM:
    """The local backend over the live policy."""
    from agentspec.llm.local import LocalLLM

    return LocalLLM(model, tokenizer, name="policy", batching=batching)
