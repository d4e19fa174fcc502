"""Retroformer (Yao et al., 2024): training the reflector on the change of return that its lessons bring.

Two LoRA adapters sit on one base. The *actor* is frozen and plays; the *reflector* reads a failed trial and writes the
lesson for the next, and it alone is trained. Calls find their adapter by their tag. A group of GRPO is one failed trial
of a task, k lessons about it, and k further trials, each played with one of them:

1. each task of the round is played once, from an empty memory;
2. if that trial failed, k episodes start from the memory it left. Each begins by writing its own lesson
   (`when: start`) and is paid `G(this trial) - G(failed trial)` (reward `reflection_gain`);
3. if it did not fail, there is nothing to learn: the trial stands in for the k episodes, without rows or gradient.

The actor is greedy (`actor_temperature: 0`), so that what changes between trials is owed to the lesson; a lesson is
sampled at the agent's temperature. Everything else is `trainers.grpo.ScaffoldGRPOTrainer`. The paper trains its
reflector with a reward model and PPO on stored lessons; here the group is the baseline, and lessons are always fresh.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from accelerate.utils import gather_object
from torch import nn

from agentspec.episode import Job
from agentspec.llm.recorder import derive_seed
from agentspec.metrics import means
from agentspec.reflection.retroformer import PATH
from agentspec.spec import AgentSpec, ModuleSpec, load_yaml
from agentspec.trajectory import Trajectory
from trainers.checks import REWARD, check_retroformer
from trainers.config import ScaffoldConfig
from trainers.credit import Credited, ScoredEpisode
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.policy import ACTOR, TRAINED
from trainers.rollouts import collect, local_llm
from trainers.sequences import TrainFilter
from trainers.unread import REFLECTION

ADAPTERS = {PATH: TRAINED, "*": ACTOR}
"""Which adapter answers: lessons come from the trained one, everything else from the actor's."""

FIRST_TRIALS = "first_trials"
"""Folder of a run that holds the trials that were reflected on, one file per generation round."""


def as_retroformer(config: ScaffoldConfig) -> ScaffoldConfig:
    """Make `config` train the reflector, and nothing else; `SpecError` where it says otherwise.

    The agent's reflection becomes `retroformer` with `when: start` and its scope `run`; the lessons are the
    trained calls; the reward, unless one is given, is the change of return.
    """
    agent = load_yaml(config.agent) if isinstance(config.agent, str) else config.agent
    if isinstance(agent, Mapping):  # lessons live from trial to trial, and a reflector refuses any other scope
        config.agent = {**agent, "scope": "run"}
    spec = config.spec
    if spec.reflection.name in ("none", REFLECTION):
        reflection = ModuleSpec(REFLECTION, {"when": "start", **spec.reflection.params})
        config.agent = replace(spec, scope="run", reflection=reflection).to_data()
    if tuple(config.train_calls) == TrainFilter().patterns:
        config.train_calls = [PATH]
    config.rewards = config.rewards or {REWARD: 1.0}
    check_retroformer(config)
    return config


class RetroformerTrainer(ScaffoldGRPOTrainer):
    """GRPO for the reflector of a frozen actor: `model` of `load_actor_and_reflector`, `args` of `as_retroformer`."""

    def __init__(self, model: nn.Module, args: ScaffoldConfig, **kwargs: Any) -> None:
        check_retroformer(args)
        kwargs.setdefault("make_llm", partial(local_llm, batching=args.batching, adapters=ADAPTERS))
        super().__init__(model, args, **kwargs)
        self._first_trials: list[ScoredEpisode] = []

    def _load_from_checkpoint(self, resume_from_checkpoint: str, model: Any = None) -> None:
        """As transformers does; its older versions leave out an adapter that lies beside the folder of another."""
        super()._load_from_checkpoint(resume_from_checkpoint, model)
        (model or self.model).load_adapter(resume_from_checkpoint, TRAINED, is_trainable=True)

    def _play(self, jobs: Sequence[Job], spec: AgentSpec | None = None) -> list[ScoredEpisode]:
        runner = self._runner(spec or acting_scaffold(self.args))
        self._first_trials, episodes = play_trials(
            lambda trials: collect(runner, trials, self.rewards_used, retries=self.args.retries), jobs
        )
        return episodes

    def _carried_memory(self) -> bytes | None:
        """None: every round's first trials are first trials."""
        return None

    def _check_trained(self) -> None:
        """As for any run, unless no first trial of any rank failed: then there is nothing to learn from this round."""
        if any(gather_object([any(map(has_lesson, self.last_episodes))])):
            super()._check_trained()

    def _log_episodes(self, credited: Credited) -> None:
        """As for any run; also what the lessons were worth, and the trials they are about."""
        super()._log_episodes(credited)
        firsts = [e.trajectory for e in self._first_trials]
        rows = [{"failed_first_trials": is_due(t), "first_return": t.metrics["return"]} for t in firsts if t.scorable]
        rows += [{"gain": t.metrics["reflection/reward"]} for t in self.last_episodes if t.scorable and has_lesson(t)]
        for name, value in means(rows).items():
            self._metrics["train"][f"reflection/{name}"].append(value)
        self.run_log.trajectories(self._round, self.accelerator.process_index, firsts, FIRST_TRIALS)


def play_trials(
    play: Callable[[Sequence[Job]], list[ScoredEpisode]], jobs: Sequence[Job]
) -> tuple[list[ScoredEpisode], list[ScoredEpisode]]:
    """The first trial of each group of jobs, and for every job the trial that follows it.

    Where the first trial left no lesson to be written, it takes the episode's place (under the job's rollout number).

    Args:
    play: jobs -> episodes, in order.
    jobs: groups one after the other; a group begins with rollout 0.
    """
    heads = [replace(j, run_seed=derive_seed(j.run_seed, "first trial")) for j in jobs if j.rollout == 0]
    firsts = play(heads)
    groups = [i for i, j in enumerate(jobs) if j.rollout == 0]
    before = [firsts[sum(start <= i for start in groups) - 1] for i in range(len(jobs))]
    due = [i for i, first in enumerate(before) if is_due(first.trajectory)]
    episodes = [
        replace(first, trajectory=replace(first.trajectory, rollout=job.rollout))
        for first, job in zip(before, jobs, strict=True)
    ]
    followed = play([replace(jobs[i], memory_state=before[i].trajectory.memory_state) for i in due])
    for i, episode in zip(due, followed, strict=True):
        episodes[i] = episode
    return firsts, episodes


def is_due(trajectory: Trajectory) -> bool:
    """Whether the trial failed and waits to be reflected on."""
    return trajectory.scorable and bool(trajectory.metrics.get("reflection/due"))


def has_lesson(trajectory: Trajectory) -> bool:
    """Whether the episode began with a lesson, which it now pays."""
    return "reflection/reward" in trajectory.metrics


def acting_scaffold(config: ScaffoldConfig) -> AgentSpec:
    """The scaffold with the actor at `actor_temperature` and lessons at the agent's own temperature."""
    spec = config.spec
    params = {"temperature": spec.sampling.temperature, **spec.reflection.params}
    sampling = replace(spec.sampling, temperature=config.actor_temperature)
    return replace(spec, reflection=ModuleSpec(spec.reflection.name, params), sampling=sampling)
