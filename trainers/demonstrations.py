"""Expert episodes -> rows for a supervised warm start, in the layout that the policy will meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from agentspec.episode import Job, MakeEnv, Runner, make_env
from agentspec.llm.demonstration import DemonstrationLLM
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec, ModuleSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from trainers.sequences import TrainFilter, build_sequences


@dataclass(frozen=True)
class Demonstrations:
    """Rows of token ids and which of them the expert wrote (1), and the episodes they come from."""

    rows: list[dict[str, list[int]]]
    episodes: list[Trajectory]


def demonstrate(
    spec: AgentSpec,
    tokenizer: Any,
    tasks: Sequence[Task],
    *,
    expert: str = "rule_based",
    make_env: MakeEnv = make_env,
) -> Demonstrations:
    """Play ``tasks`` with the expert, then again inside ``spec`` with the expert's actions as answers.

    The second pass writes the prompts of the scaffold; the environment is deterministic, so both passes agree.

    Raises:
        SpecError: an episode failed, or the scaffold does not make one acting call per step.
    """
    jobs = [Job(task) for task in tasks]
    scripted = replace(spec, reasoning=ModuleSpec(expert), memory=ModuleSpec("none"), reflection=ModuleSpec("none"))
    played = Runner(scripted, make_env=make_env).run(jobs)
    names = [f"{job.task.key}-{job.rollout}-{job.seed:x}" for job in jobs]
    actions = {n: [t.action_text for t in episode.transitions] for n, episode in zip(names, played, strict=True)}
    episodes = Runner(spec, DemonstrationLLM(tokenizer, actions), make_env=make_env).run(jobs)
    failed = [t.error for t in (*played, *episodes) if not t.scorable]
    if failed:
        raise SpecError(f"{len(failed)} of {2 * len(jobs)} demonstration episodes failed, the first with: {failed[0]}")
    rows = [
        {"input_ids": s.tokens, "assistant_masks": [int(c >= 0) for c in s.calls]}
        for episode in episodes
        for s in build_sequences(episode, TrainFilter())
    ]
    return Demonstrations(rows, episodes)
