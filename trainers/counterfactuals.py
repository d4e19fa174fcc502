"""Episodes beside the batch that say what a write to memory was worth: played, recorded, told apart.

A re-roll begins in exactly the state in which the write was asked for: the episode is played again with its recorded
answers (`agentspec.llm.replayed`). The write itself is then either the recorded one, or withheld: the module is told
that no answer came, and does what it does then. From there on the policy samples anew; re-rolls of one number sample
with the same seeds with and without the write, so that a write which no prompt shows earns exactly nothing.

Records carry their plan in their metrics (`counterfactual/...`) and lie in the run's folder `counterfactuals`.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace

from agentspec.episode import Job, Runner
from agentspec.llm.none import NoLLM
from agentspec.llm.recorder import derive_seed
from agentspec.llm.replayed import ReplayedLLM, key_of
from agentspec.spec import ModuleSpec
from agentspec.trajectory import Trajectory
from agentspec.types import LLMCall
from rewards.base import NonFiniteRewardError
from trainers.credit import CreditRule, ScoredEpisode
from trainers.writes import EVERY, Plan

FOLDER = "counterfactuals"
"""Folder of a run that holds them, one file per generation round."""


def prefix(trajectory: Trajectory, plan: Plan, is_write: Callable[[str], bool]) -> list[LLMCall]:
    """The recorded calls that a re-roll repeats: all before the write, and the write where it is kept."""
    writes = [c.id for c in trajectory.calls if c.tag.step == plan.step and is_write(c.tag.path)]
    first = min(writes, default=-1)
    kept = set(writes) if plan.kept else set()
    return [c for c in trajectory.calls if c.id < first or c.id in kept]


def play_beside(
    runner: Runner, jobs: Sequence[Job], episodes: Sequence[ScoredEpisode], rule: CreditRule, *, retries: int = 0
) -> list[ScoredEpisode]:
    """The episodes (of `jobs`, in order, as `runner` played them) with the counterfactuals that the rule wants."""
    wanted = [
        (e.trajectory, plan, _job(job, e.trajectory, retries))
        for job, e in zip(jobs, episodes, strict=True)
        for plan in rule.writes.plan(e.trajectory, rule.train)
    ]
    return attach(episodes, asyncio.run(_play_all(runner, wanted, rule)), rule) if wanted else list(episodes)


def _job(job: Job, trajectory: Trajectory, retries: int) -> Job:
    """The job as it was played at last: a failed one was played again with a run seed of its own."""
    seeds = [job.run_seed, *(derive_seed(job.run_seed, "retry", n) for n in range(1, retries + 1))]
    again = (replace(job, run_seed=seed) for seed in seeds)
    return next((j for j in again if j.seed == trajectory.seed), job)


async def _play_all(
    runner: Runner, wanted: Sequence[tuple[Trajectory, Plan, Job]], rule: CreditRule
) -> list[Trajectory]:
    gate = asyncio.Semaphore(runner.concurrency or len(wanted))

    async def play(recorded: Trajectory, plan: Plan, job: Job) -> Trajectory:
        async with gate:
            [trajectory] = await _runner(runner, recorded, plan, rule).run_async([job])
        return settled(trajectory, recorded, plan, rule)

    return list(await asyncio.gather(*(play(*one) for one in wanted)))


def _runner(runner: Runner, recorded: Trajectory, plan: Plan, rule: CreditRule) -> Runner:
    """What plays one counterfactual: the agent without memory, or the recorded beginning and then the policy."""
    quiet = replace(runner, progress=None, on_done=None, on_step=None)
    if plan.step == EVERY:
        return replace(quiet, spec=replace(runner.spec, memory=ModuleSpec("none")))
    is_write = rule.writes.is_write
    replayed = ReplayedLLM(
        runner.llm or NoLLM(),
        prefix(recorded, plan, is_write),
        step=plan.step,
        withheld=lambda r: not plan.kept and r.tag.step == plan.step and is_write(r.tag.path),
        seeds=(recorded.seed, "reroll", plan.number),
        suffix=f"~{plan.step}{'with' if plan.kept else 'without'}{plan.number}",
    )
    return replace(quiet, llm=replayed)


def marks(plan: Plan) -> dict[str, int]:
    """What the metrics of a record say of its plan."""
    return {f"counterfactual/{name}": value for name, value in asdict(plan).items()}


def settled(trajectory: Trajectory, episode: Trajectory, plan: Plan, rule: CreditRule) -> Trajectory:
    """The record with its plan; failed if it is another thing (a module that does not repeat), or earned no number."""
    trajectory = replace(trajectory, metrics={**trajectory.metrics, **marks(plan)})
    problems = list(differences(episode, trajectory, plan, rule))
    try:
        rule.score([trajectory])
    except NonFiniteRewardError as error:
        problems.append(f"not finite: {error}")
    return replace(trajectory, status="failed", error="; ".join(problems)) if problems else trajectory


def records(episodes: Sequence[ScoredEpisode]) -> list[Trajectory]:
    """All counterfactuals of a round, in order."""
    return [other.trajectory for episode in episodes for _, other in episode.beside]


def attach(
    episodes: Sequence[ScoredEpisode], beside: Sequence[Trajectory], rule: CreditRule, problems: list[str] | None = None
) -> list[ScoredEpisode]:
    """Give every episode those of its counterfactuals that the rule wants, scored; all are in the order of records.

    Args:
        problems: where to say what is missing, left over or not what it claims (the audit's).

    Raises:
        ValueError: a counterfactual is missing, and nobody wants to be told.
    """
    found = iter(beside)
    attached = []
    for episode in episodes:
        wanted = rule.writes.plan(episode.trajectory, rule.train)
        records = rule.score([record for _, record in zip(wanted, found, strict=False)])
        mine = list(zip(wanted, records, strict=False))
        told = [w for plan, other in mine for w in differences(episode.trajectory, other.trajectory, plan, rule)]
        if len(mine) < len(wanted):
            told.append(f"{episode.trajectory.episode} has {len(mine)} counterfactuals, expected {len(wanted)}")
        if told and problems is None:
            raise ValueError("; ".join(told))
        (problems if problems is not None else []).extend(told)
        attached.append(replace(episode, beside=tuple(mine)))
    left = len(list(found))
    if left and problems is not None:
        problems.append(f"{left} counterfactuals belong to no write")
    return attached


def differences(episode: Trajectory, other: Trajectory, plan: Plan, rule: CreditRule) -> Iterator[str]:
    """What makes a record another thing than the counterfactual of `plan` of this episode (nothing: it is that)."""
    where = f"counterfactual of step {plan.step} of {episode.episode}"
    if (other.task, other.rollout, other.seed) != (episode.task, episode.rollout, episode.seed):
        yield f"{where}: it is of {other.episode}"
    if other.policy != episode.policy:
        yield f"{where}: it was played by policy {other.policy}"
    if any(other.metrics.get(name) != value for name, value in marks(plan).items()):
        yield f"{where}: its plan is not {plan}"
    if plan.step == EVERY and any(c.tag.module.startswith("memory.") for c in other.calls):
        yield f"{where}: it has calls of memory"
    if plan.step == EVERY or not other.scorable:
        return
    for name, ours, theirs in (
        ("steps", _before(episode, plan.step), _before(other, plan.step)),
        ("calls", _sampled(prefix(episode, plan, rule.writes.is_write)), _sampled(_first(other, episode, plan, rule))),
    ):
        if ours != theirs:
            yield f"{where}: its {name} before the write are not those of the episode"
    if not plan.kept and any(c.tag.step == plan.step and rule.writes.is_write(c.tag.path) for c in other.calls):
        yield f"{where}: the write was to be withheld"


def _before(trajectory: Trajectory, step: int) -> list[tuple[object, ...]]:
    return [(t.input.text, t.action_text, t.reward) for t in trajectory.transitions[:step]]


def _sampled(calls: Sequence[LLMCall]) -> list[tuple[object, ...]]:
    return sorted((*key_of(c), c.prompt_ids, tuple((x.token_ids, x.logprobs) for x in c.completions)) for c in calls)


def _first(other: Trajectory, episode: Trajectory, plan: Plan, rule: CreditRule) -> list[LLMCall]:
    """As many of a re-roll's calls as the episode's beginning has, key by key."""
    left = Counter(key_of(c) for c in prefix(episode, plan, rule.writes.is_write))
    found = []
    for call in sorted(other.calls, key=lambda c: c.id):
        if left[key_of(call)] > 0:
            left[key_of(call)] -= 1
            found.append(call)
    return found
