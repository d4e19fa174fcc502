"""Failures of a matrix: which kinds, how often, per scaffold and beside the paper's shares.

The rules of `agentspec.failures` judge what the record proves. What they leave open, a model may judge (`eval.judge`).
How far to believe either, a labelled sample says (`eval.labels`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from agentspec.actions import parse_action
from agentspec.episode import make_env
from agentspec.failures import Sign, is_failure, leading, signs
from agentspec.files import jsonable
from agentspec.perception.generic import GenericPerception
from agentspec.simulator import OBJECTS_IN_INFO
from agentspec.trajectory import Trajectory
from agentspec.types import ActionError, Decision, Task, Transition
from eval.judge import Judge

OPEN = "open"
"""Failures that no rule explains and nobody judged."""


@dataclass(frozen=True)
class Diagnosis:
    """What is known of one episode.

    Args:
        failed: `None` where it could not be played to its end.
        leaf: leading kind of failure; `open` without one; empty for a success.
        judged: whether a model chose it.
    """

    failed: bool | None
    leaf: str
    signs: tuple[Sign, ...] = ()
    judged: bool = False


def diagnose(trajectory: Trajectory, judge: Judge | None = None) -> Diagnosis:
    """The leading kind of failure of an episode, by rules, and by the judge where they are silent."""
    failed = is_failure(trajectory)
    found = tuple(signs(trajectory)) if failed is not None else ()
    if not failed:
        return Diagnosis(failed, "", found)
    if leaf := leading(found):
        return Diagnosis(True, leaf, found)
    judged = judge.ask(trajectory) if judge else ""
    return Diagnosis(True, judged or OPEN, found, bool(judged))


@dataclass
class Shares:
    """Counts of one group of episodes (a scaffold, a world)."""

    episodes: int = 0
    failed: int = 0
    leaves: Counter[str] = field(default_factory=Counter)
    signs: Counter[str] = field(default_factory=Counter)

    def add(self, diagnosis: Diagnosis) -> None:
        """Count an episode that was played to its end."""
        if diagnosis.failed is None:
            return
        self.episodes += 1
        self.failed += diagnosis.failed
        if diagnosis.failed:
            self.leaves[diagnosis.leaf] += 1
        self.signs.update({sign.leaf for sign in diagnosis.signs})

    def share(self, leaf: str) -> float:
        """Of all failures, the share that this kind leads."""
        return self.leaves[leaf] / self.failed if self.failed else 0.0


def by_scaffold(diagnosed: Iterable[tuple[str, str, Diagnosis]]) -> dict[tuple[str, str], Shares]:
    """(world, scaffold) -> counts, from (world, scaffold, diagnosis) of episodes."""
    found: dict[tuple[str, str], Shares] = {}
    for world, scaffold, diagnosis in diagnosed:
        found.setdefault((world, scaffold), Shares()).add(diagnosis)
    return found


def paper_shares(world: str) -> dict[str, float]:
    """Leaf -> share of failures (0 to 1) as the paper prints it for a world; empty for worlds that it has not."""
    from eval.paper import numbers

    prefix = "failure_share_percent/"
    rows = [n for n in numbers() if n.table == "failure_taxonomy" and n.environment == world]
    return {n.metric.removeprefix(prefix): n.value / 100 for n in rows}


# -- episodes without an agent ---------------------------------------------------------------------


def replayed(task: Task, actions: Sequence[str]) -> Trajectory:
    """The episode in which these texts were executed, one per step, to the end of the texts or of the episode."""
    texts = iter(actions)
    return played(task, lambda text, info: next(texts, None))


def played(task: Task, act: Callable[[str, Mapping[str, Any]], str | None]) -> Trajectory:
    """The episode that a function plays without an agent: (observation's text, info) -> next text, `None` to end it."""
    env, perception = make_env(task), GenericPerception()
    observation, info = env.reset(seed=task.seed)
    steps: list[Transition] = []
    while not (steps and (steps[-1].terminated or steps[-1].truncated)):
        text = act(str(observation["text"]), info)
        if text is None:
            break
        shown = perception.perceive(task, observation, info)
        action = parse_action(text, info["action_schema"])
        observation, reward, terminated, truncated, info = env.step(text)
        report = {k: jsonable(v) for k, v in info.items() if k not in OBJECTS_IN_INFO}
        decision = Decision(action, valid=not isinstance(action, ActionError))
        seen = str(observation["text"])
        steps.append(
            Transition(
                len(steps), shown, decision, text, float(reward), seen, bool(terminated), bool(truncated), report
            )
        )
    env.close()
    metrics = {**jsonable(info.get("metrics", {})), "return": sum(t.reward for t in steps), "steps": len(steps)}
    return Trajectory(task, {}, transitions=tuple(steps), metrics=metrics)
