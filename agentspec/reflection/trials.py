"""Trials of a task: what counts as failure, which lessons belong to it, and how a trial reads.

Shared by the methods that learn in words from one episode to the next. Lessons are kept per task (`key="task"`: the
same world, options and seed, tried again) or per task family (`key="family"`: the same world and options, whatever
the seed), which is what a stream of unseen tasks needs.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from agentspec.llm.base import Message, system, user
from agentspec.memory.base import describe
from agentspec.prompting import clip, static_prompt
from agentspec.reading import read
from agentspec.services import Services
from agentspec.tokens import CountTokens
from agentspec.trajectory import Trajectory
from agentspec.types import Action, Recall, RecallItem, Task, Transition
from agentspec.visible import visible

KEYS = ("task", "family")

HEADER = "Lessons from earlier trials of this task:"
TRIAL = "Trial {number}: {lesson}"
SITUATION = "At the beginning:\n{text}"
FULLEST = "Before step {number}:\n{text}"
OFFERED = "Actions on offer at first: {choices}"
MAX_THOUGHT = 200
"""Signs of a thought that a reflector is shown."""


def key_of(task: Task, by: str) -> str:
    """The name under which lessons of `task` are kept."""
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
        """Read `to_data`."""
        return cls(data["trials"], data["best"], [(number, text) for number, text in data["lessons"]])

    def recall(self, last: int, source: str) -> Recall:
        """The `last` lessons, in the order they were learnt; the newest matter most."""
        shown = [(TRIAL.format(number=number, lesson=text), number) for number, text in self.lessons[-last:]]
        return Recall(tuple(RecallItem(text, kind="lesson", source=source, priority=n) for text, n in shown))


def episode_return(trajectory: Trajectory) -> float:
    """Sum of the episode's rewards."""
    return sum(t.reward for t in trajectory.transitions)


def failed(trajectory: Trajectory, best: float | None, threshold: float | None, max_repeats: int = 0) -> bool:
    """Whether a trial counts as failed.

    In this order: the environment's own `success` metric; the same action `max_repeats` times in a row without a reward
    (0: not looked at); a return below `threshold`. Without a threshold a graded task has no success, only better and
    worse: a trial fails unless it beats the `best` of the task's earlier trials, and the first one has beaten nothing.
    """
    success = trajectory.metrics.get("success")
    if success is not None:
        return not success
    if max_repeats and _longest_repeat(trajectory) >= max_repeats:
        return True
    total = episode_return(trajectory)
    if threshold is not None:
        return total < threshold
    return best is None or total <= best


def _longest_repeat(trajectory: Trajectory) -> int:
    longest = run = 0
    before = None
    for t in trajectory.transitions:
        run = run + 1 if t.action_text == before and not t.reward else 1
        before = t.action_text
        longest = max(longest, run)
    return longest


def trial_prompt(
    trajectory: Trajectory,
    log: TrialLog,
    last: int,
    request: str,
    budget: int,
    services: Services,
    view_tokens: int = 512,
    fullest_tokens: int = 1024,
) -> tuple[Message, ...]:
    """The trial as a reflector reads it.

    The task and its actions; earlier lessons; how it began, and the fullest view of the trial (the board of offers,
    say), in `view_tokens` and `fullest_tokens`; its steps with the thought behind each and what came of it, within
    `budget` tokens: of a long trial the older steps lose their thoughts first, and a line says how many are left out;
    its return and how it ended; the request.
    """
    first = trajectory.transitions[0].input
    count = services.llm.count_tokens
    steps = "\n".join(_steps_within(trajectory, budget, count))
    earlier = "\n".join(TRIAL.format(number=n, lesson=text) for n, text in log.lessons[-last:])
    fullest = max(trajectory.transitions, key=lambda t: len(t.input.text))
    parts = [
        *([f"{HEADER}\n{earlier}"] if earlier else []),
        SITUATION.format(text=clip(first.text, view_tokens, services)),
        *(
            [FULLEST.format(number=fullest.step + 1, text=clip(fullest.input.text, fullest_tokens, services))]
            if fullest.input.text != first.text
            else []
        ),
        f"The steps of trial {log.trials}:\n{steps}",
        f"Its return was {episode_return(trajectory):g}"
        + (f" (best so far {log.best:g}). " if log.best is not None else ". ")
        + _end(trajectory),
        request,
    ]
    return (
        system(
            static_prompt(
                first,
                OFFERED.format(choices="; ".join(first.action_schema.choices)) if first.action_schema.choices else "",
            )
        ),
        user("\n\n".join(parts)),
    )


def _end(trajectory: Trajectory) -> str:
    """How a trial ended, in a sentence."""
    last = trajectory.transitions[-1]
    if not last.terminated:
        return f"It was cut off after step {last.step + 1}."
    return f"It ended with step {last.step + 1}{'' if trajectory.metrics.get('success', 1) else ', without success'}."


def _steps_within(trajectory: Trajectory, budget: int, count: CountTokens) -> list[str]:
    """The steps of a trial, one a line; the newest keep their thoughts, then as many as fit are told without."""
    bare = [describe(t) for t in trajectory.transitions]
    costs = [count(line) + 1 for line in bare]
    shown, used = len(bare), 0
    while shown and used + costs[shown - 1] <= budget:
        shown -= 1
        used += costs[shown]
    lines = bare[shown:]
    for i in range(len(bare) - 1, shown - 1, -1):
        told = _told(trajectory.transitions[i])
        used += count(told) + 1 - costs[i]
        if used > budget:
            break
        lines[i - shown] = told
    return ([f"(the first {shown} steps are left out)"] if shown else []) + lines


def _told(transition: Transition) -> str:
    """A step on one line, with the thought behind it."""
    reading = read(transition.decision.rationale, transition.input.action_schema)
    thought = reading.thought if isinstance(reading.action, Action) else visible(transition.decision.rationale)[0]
    thought = " ".join(thought.split()).removeprefix("Thought:").strip()
    if len(thought) > MAX_THOUGHT:
        thought = thought[:MAX_THOUGHT] + "..."
    line = describe(transition)
    return f"{line} (thought: {thought})" if thought else line
