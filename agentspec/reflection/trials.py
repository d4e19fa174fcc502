"""Trials of a task: what counts as failure, which lessons belong to it, and how a trial reads.

Shared by the methods that learn in words from one episode to the next. Lessons are kept per task (``key="task"``: the
same world, options and seed, tried again) or per task family (``key="family"``: the same world and options, whatever
the seed), which is what a stream of unseen tasks needs.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from agentspec.llm.base import Message, system, user
from agentspec.memory.base import describe
from agentspec.trajectory import Trajectory
from agentspec.types import Recall, RecallItem, Task

KEYS = ("task", "family")

HEADER = "Lessons from earlier trials of this task:"
TRIAL = "Trial {number}: {lesson}"
SITUATION = "At the beginning:\n{text}"


def key_of(task: Task, by: str) -> str:
    """The name under which lessons of ``task`` are kept."""
    if by == "task":
        return task.key
    text = json.dumps([task.env, task.options], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@dataclass
class TrialLog:
    """What is known of one task: trials so far, the best return, and lessons as (trial, text), oldest first."""

    trials: int = 0
    best: float | None = None
    lessons: list[tuple[int, str]] = field(default_factory=list)

    def to_data(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> TrialLog:
        """Read :meth:`to_data`."""
        return cls(data["trials"], data["best"], [(number, text) for number, text in data["lessons"]])

    def recall(self, last: int, source: str) -> Recall:
        """The ``last`` lessons, in the order they were learnt; the newest matter most."""
        shown = [(TRIAL.format(number=number, lesson=text), number) for number, text in self.lessons[-last:]]
        return Recall(tuple(RecallItem(text, kind="lesson", source=source, priority=n) for text, n in shown))


def episode_return(trajectory: Trajectory) -> float:
    """Sum of the episode's rewards."""
    return sum(t.reward for t in trajectory.transitions)


def failed(trajectory: Trajectory, best: float | None, threshold: float | None, max_repeats: int = 0) -> bool:
    """Whether a trial counts as failed.

    In this order: the environment's own ``success`` metric; the same action ``max_repeats`` times in a row without a
    reward (0: not looked at); a return below ``threshold``; without a threshold, a return below the ``best`` of the
    task's earlier trials, or, in its first trial, no positive return.
    """
    success = trajectory.metrics.get("success")
    if success is not None:
        return not success
    if max_repeats and _longest_repeat(trajectory) >= max_repeats:
        return True
    total = episode_return(trajectory)
    if threshold is not None:
        return total < threshold
    return total <= 0 if best is None else total < best


def _longest_repeat(trajectory: Trajectory) -> int:
    longest = run = 0
    before = None
    for t in trajectory.transitions:
        run = run + 1 if t.action_text == before and not t.reward else 1
        before = t.action_text
        longest = max(longest, run)
    return longest


def trial_prompt(
    trajectory: Trajectory, log: TrialLog, last: int, request: str, budget: int, count_tokens: Callable[[str], int]
) -> tuple[Message, ...]:
    """The trial as a reflector reads it: the task, earlier lessons, how it began, its steps, its return, the request.

    Of the steps the newest that fit into ``budget`` tokens are shown.
    """
    first = trajectory.transitions[0].input
    lines: list[str] = []
    used = 0
    for transition in reversed(trajectory.transitions):
        line = describe(transition)
        used += count_tokens(line) + 1
        if used > budget:
            break
        lines.append(line)
    steps = "\n".join(reversed(lines))
    earlier = "\n".join(TRIAL.format(number=n, lesson=text) for n, text in log.lessons[-last:])
    parts = [
        *([f"{HEADER}\n{earlier}"] if earlier else []),
        SITUATION.format(text=first.text),
        f"The steps of trial {log.trials}:\n{steps}",
        f"Its return was {episode_return(trajectory):g}" + (f" (best so far {log.best:g})." if log.best else "."),
        request,
    ]
    return (system(first.instruction), user("\n\n".join(parts)))
