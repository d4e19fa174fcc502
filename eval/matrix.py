"""The matrix: every policy plays every scaffold on the same tasks.

Which scaffold, trained how, for which task? The answer is a table whose cells must be comparable: all policies and
scaffolds get identical tasks (environment, options and seed) and identical seeds of their own draws. One model is in
memory at a time and serves all of its scaffolds; each finished episode is a line of ``results.jsonl``, and a stopped
evaluation goes on from there.
"""

from __future__ import annotations

import asyncio
import gc
import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from agentspec.actions import suggest
from agentspec.carry import MemoryBank, play_in_order, start_bank
from agentspec.episode import Job, MakeEnv, Runner, make_env
from agentspec.llm.base import LLM
from agentspec.llm.pricing import Prices
from agentspec.metrics import episode_row
from agentspec.policies import Policy, check_agent
from agentspec.progress import episode_progress, load_policy
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.tasks import Tasks, task_sets
from agentspec.trajectory import Trajectory, jsonable, write_trajectories
from agentspec.types import Sampling, Task
from eval.results import Results

MakeLLM = Callable[[Policy], LLM | None]

GREEDY: Mapping[str, Any] = {"temperature": 0.0}


@dataclass(frozen=True)
class Settings:
    """How an evaluation plays.

    Args:
        rollouts: episodes per task (they differ in the agent's own draws; averaged before intervals are taken).
        seed: seed of the evaluation; the same for all policies.
        sampling: fields of :class:`~agentspec.types.Sampling` that replace those of every scaffold; ``None``: greedy.
        concurrency: most episodes at once (``None``: all of a scaffold's).
        timeout_s: limit of one environment call, in seconds.
        max_steps: most steps of an episode, on top of the environment's own limit.
        prices: dollars per token, by model name.
        trajectories: keep every episode under ``trajectories/``.
        start_memory: for scaffolds with ``scope: run``, a memory file or the folder of a run that wrote one: every
            chain of episodes starts from it. A mapping gives policies, by name, starts of their own; others have none.
        retry_failed: play cells again whose line says that they failed.
        replace_stale: play cells again whose line is from another configuration (retrained weights, say) instead of
            refusing them.
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
    replace_stale: bool = False

    def __post_init__(self) -> None:
        if self.rollouts < 1:
            raise ValueError(f"rollouts must be at least 1, got {self.rollouts}")
        names = Sampling.__dataclass_fields__
        for name in self.sampling or ():
            if name not in names:
                raise SpecError(f"unknown key {name!r} in sampling{suggest(name, names)}")

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
        return replace(spec, sampling=replace(spec.sampling, **(GREEDY if self.sampling is None else self.sampling)))


@dataclass(frozen=True)
class Setting:
    """One row-and-column pair of the matrix with what is still to play.

    Args:
        fingerprints: task key -> digest of everything that the task's rows depend on.
        chains: lists of jobs. With `scope: run` the episodes of a chain follow each other and memory runs through.
        start: what each chain starts from.
    """

    policy: Policy
    scaffold: str
    spec: AgentSpec
    fingerprints: Mapping[str, str]
    chains: tuple[tuple[Job, ...], ...]
    start: MemoryBank

    @property
    def jobs(self) -> list[Job]:
        """All jobs."""
        return [job for chain in self.chains for job in chain]


def evaluate(
    policies: Sequence[Policy],
    specs: Mapping[str, AgentSpec],
    tasks: Tasks,
    *,
    out: str | Path,
    settings: Settings | None = None,
    make_llm: MakeLLM | None = None,
    make_env: MakeEnv = make_env,
    on_row: Callable[[dict[str, Any]], None] | None = None,
    **changes: Any,
) -> list[dict[str, Any]]:
    """Play policies x scaffolds x tasks and return one row per episode (see :func:`agentspec.metrics.episode_row`).

    Args:
        policies: rows of the matrix; names must differ.
        specs: scaffold by label: columns of the matrix.
        tasks: tasks, or several labelled sets of them (one table each); no task may stand in two sets.
        out: folder of ``results.jsonl``, or another ``.jsonl`` file; existing lines are kept and their cells not
            played again.
        settings: how to play; keyword arguments ``changes`` are fields of it that replace its own.
        make_llm: policy -> loaded backend; default: what the policy says. Called once per policy that has to play.
        make_env: task -> environment.
        on_row: told of every finished episode.

    Raises:
        SpecError: names that clash, a scaffold the backend cannot serve, or lines in ``out`` from another
            configuration under the same names.
        ModelNotFoundError: a policy's model does not exist. As any error of making an environment (an unknown name, a
            map that is not there), it is raised before anything is played.
    """
    settings = replace(settings or Settings(), **changes)
    if settings.start_memory and not any(spec.scope == "run" for spec in specs.values()):
        raise SpecError("start_memory is given, but no scaffold has `scope: run`: every episode would start empty")
    sets = task_sets(tasks)
    _check_names(policies, specs)
    if isinstance(settings.start_memory, Mapping):
        for name in settings.start_memory:
            if name not in (known := [p.name for p in policies]):
                raise SpecError(f"start_memory names the policy {name!r}{suggest(name, known)}")
    results = Results(out)
    labels = {task.key: label for label, members in sets.items() for task in members}
    plan = [
        [_setting(policy, label, spec, sets, settings, results) for label, spec in specs.items()] for policy in policies
    ]
    playing = [[s for s in row if s.jobs] for row in plan]
    _check_first(playing, sets, make_llm, make_env)
    results.discard(
        (s.policy.name, s.scaffold, job.task.key, job.rollout) for row in playing for s in row for job in s.jobs
    )

    def finished(setting: Setting, trajectory: Trajectory) -> None:
        if settings.trajectories:
            write_trajectories(_trajectory_path(results.trajectories, setting, trajectory), [trajectory])
        row = {
            "policy": setting.policy.name,
            "scaffold": setting.scaffold,
            "tasks": labels[trajectory.task.key],
            "fingerprint": setting.fingerprints[trajectory.task.key],
            **episode_row(trajectory),
        }
        results.append(row)
        if on_row:
            on_row(row)

    for row in playing:
        if row:
            llm = (make_llm or load_policy)(row[0].policy)
            asyncio.run(_play(row, llm, settings, make_env, finished))
            del llm
            gc.collect()  # the next model needs the memory now, not when the collector gets to the cycles
    wanted = [
        (s.policy.name, s.scaffold, key, rollout)
        for row in plan
        for s in row
        for key in labels
        for rollout in range(settings.rollouts)
    ]
    return [results.by_cell[cell] for cell in wanted]


async def _play(
    row: Sequence[Setting],
    llm: LLM | None,
    settings: Settings,
    make_env: MakeEnv,
    finished: Callable[[Setting, Trajectory], None],
) -> None:
    """All scaffolds of one policy, one after the other, on one loop: the backend may keep what belongs to the loop."""
    for setting in row:
        runner = Runner(
            setting.spec,
            llm,
            make_env=make_env,
            concurrency=settings.concurrency,
            timeout_s=settings.timeout_s,
            max_steps=settings.max_steps,
            prices=settings.prices,
            policy=setting.policy.name,
            progress=episode_progress,
            on_done=lambda trajectory, setting=setting: finished(setting, trajectory),  # type: ignore[misc]
        )
        if setting.spec.scope == "run":
            for chain in setting.chains:
                await play_in_order(runner, chain, setting.start)
        else:
            await runner.run_async(setting.jobs)


def _setting(
    policy: Policy,
    label: str,
    spec: AgentSpec,
    sets: Mapping[str, Sequence[Task]],
    settings: Settings,
    results: Results,
) -> Setting:
    """What is left to play of one pair.

    Raises:
        SpecError: the file has lines of this pair from another configuration.
    """
    spec = settings.apply(policy.apply(spec))
    start = settings.start_of(policy, spec)
    fingerprints = _fingerprints(
        [spec.to_data(), policy.identity(), settings.seed, settings.max_steps], spec, sets, start
    )
    left: list[tuple[Job, ...]] = []
    for rollout in range(settings.rollouts):
        for members in sets.values():
            chain = tuple(Job(task, rollout, settings.seed) for task in members)
            missing = tuple(j for j in chain if _is_missing(policy, label, j, fingerprints, settings, results))
            if missing:  # memory that runs on cannot be entered in the middle
                left.append(chain if spec.scope == "run" else missing)
    return Setting(policy, label, spec, fingerprints, tuple(left), start)


def _fingerprints(
    content: list[Any], spec: AgentSpec, sets: Mapping[str, Sequence[Task]], start: MemoryBank
) -> dict[str, str]:
    """Task key -> digest of what its rows depend on: with `scope: run` also the start and the tasks before it."""

    def digest(*more: Any) -> str:
        text = json.dumps(jsonable([*content, *more]), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    if spec.scope != "run":
        return {task.key: digest() for members in sets.values() for task in members}
    began = hashlib.sha256(start.dump()).hexdigest()
    return {
        task.key: digest(began, [before.key for before in members[:i]])
        for members in sets.values()
        for i, task in enumerate(members)
    }


def _is_missing(
    policy: Policy, label: str, job: Job, fingerprints: Mapping[str, str], settings: Settings, results: Results
) -> bool:
    """Whether a job has no valid row yet.

    Raises:
        SpecError: it has one from another configuration.
    """
    row = results.by_cell.get((policy.name, label, job.task.key, job.rollout))
    if row is None:
        return True
    stale = row.get("fingerprint") != fingerprints[job.task.key]
    if stale and not settings.replace_stale:
        raise SpecError(
            f"{results.path} holds results of another configuration under policy {policy.name!r} and scaffold "
            f"{label!r} (spec, weights, sampling or seed differ; with `scope: run` also the start memory, or which "
            "tasks come before); choose another output folder or label, or replace them (replace_stale)"
        )
    return stale or (settings.retry_failed and row["status"] == "failed")


def _check_names(policies: Sequence[Policy], specs: Mapping[str, AgentSpec]) -> None:
    names = [p.name for p in policies]
    if not names or not specs:
        raise SpecError(f"nothing to evaluate: got {len(names)} policies and {len(specs)} scaffolds; give at least one")
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise SpecError(f"two policies are called {', '.join(twice)}; give each its own name (NAME=MODEL)")


def _check_first(
    playing: Sequence[Sequence[Setting]],
    sets: Mapping[str, Sequence[Task]],
    make_llm: MakeLLM | None,
    make_env: MakeEnv,
) -> None:
    """Make one environment of each kind and check every agent: what is missing shows before hours of work."""
    if not any(playing):
        return
    for task in {replace(t, seed=0).key: t for members in sets.values() for t in members}.values():
        env = make_env(task)
        for setting in (s for row in playing for s in row):
            if make_llm is None:
                check_agent(setting.policy, setting.spec, env, task.env)
        env.close()


def _trajectory_path(folder: Path, setting: Setting, trajectory: Trajectory) -> Path:
    folder = folder / _slug(setting.policy.name) / _slug(setting.scaffold)
    return folder / f"{trajectory.task.key}-{trajectory.rollout}.jsonl"


def _slug(name: str) -> str:
    """A file name that no two labels share."""
    plain = re.sub(r"[^\w.+-]+", "_", name).strip("._") or "x"
    return plain if plain == name else f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:6]}"
