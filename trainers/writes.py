"""What a write to memory earns: three estimators, chosen by name (`write_credit`), and the episodes they need.

A *write* is what memory has the policy say, so that it holds (or shows) something else from then on: `write_calls`, by
default every call of memory. What is asked after a step belongs to the step that follows; the calls of one step are one
write. What it earns is one of:

- `episode`: what the episode earns, as every other token does. Nothing more is played.
- `local`: for some writes of an episode, drawn by its seed, the rest of the episode is played again from the state in
  which the write was asked for, `write_rerolls` times with the write as it was made and as often without it. Both
  groups are scored as one by the run's estimator; the write earns the mean of those with it less that of those without.
  Rollouts of one task drift apart as their memories do, so that comparing a write with those of other rollouts is not
  fair to it; here both groups share all that went before. Writes that were not drawn earn 0.
- `ablation`: every episode is played once more without any memory, from the same task and seed. The group's returns
  with and without memory are scored as one; each write of an episode earns the difference of its pair.

The estimator is the run's own (of those per step, which score no whole episode, `grpo` stands in). An episode or
re-roll that failed counts nowhere; where nothing is left to compare, the writes earn 0. Everything here is plain
numbers: whoever checks a run computes the same from the recorded episodes.

Sources: the local re-rolls follow the observation of Memory-R2 that rollouts with different memories are no fair group;
the paired baseline without memory is that of D2Skill.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

from agentspec.actions import suggest
from agentspec.registry import SpecError
from agentspec.tags import matches
from agentspec.trajectory import Trajectory
from trainers.sequences import TrainFilter, trained_completions

EVERY = -1
"""In place of a step: all writes of an episode together."""

Values = Callable[[Sequence[float]], Sequence[float]]
"""Returns of one group -> their advantages."""


@dataclass(frozen=True)
class Plan:
    """A counterfactual of one episode: an episode that differs from it in what memory holds.

    Args:
        step: the step that the write belongs to; `EVERY`: the whole episode, without memory.
        kept: whether the write is made as it was, or withheld.
        number: which of the re-rolls; the same number samples with the same seeds, with and without the write.
    """

    step: int
    kept: bool
    number: int = 0


@dataclass(frozen=True)
class WriteReturn:
    """What a counterfactual earned from its step on; `None` if it failed."""

    plan: Plan
    total: float | None


@dataclass(frozen=True)
class Paired:
    """Of one episode: its return (`None` if it counts nowhere), and what its counterfactuals earned."""

    total: float | None
    returns: tuple[WriteReturn, ...] = ()


Advantages = dict[int, float]
"""Step of a write (or `EVERY`) -> what it earns."""


@dataclass(frozen=True)
class WriteCredit:
    """One row of the table.

    Args:
        plan: rule, steps of the writes, the episode's seed -> the counterfactuals that are played, in order.
        function: the episodes of one group -> advantages of the writes of each; `None`: as every other token.
        reads: settings that it reads.
    """

    name: str
    summary: str
    plan: Callable[[WriteRule, Sequence[int], int], list[Plan]]
    function: Callable[[Sequence[Paired], Values], list[Advantages]] | None = None
    reads: tuple[str, ...] = ()


@dataclass(frozen=True)
class WriteRule:
    """How writes are credited: the fields `write_...` of `trainers.config.ScaffoldConfig`."""

    credit: str = "episode"
    calls: tuple[str, ...] = ("memory.*",)
    rerolls: int = 2
    points: int = 1

    @property
    def spec(self) -> WriteCredit:
        """The row of the table."""
        return write_credit(self.credit)

    def plan(self, trajectory: Trajectory, train: TrainFilter) -> list[Plan]:
        """The counterfactuals of an episode, in the order in which they are recorded; none of one that failed."""
        steps = self.steps(trajectory, train) if trajectory.scorable else []
        return self.spec.plan(self, steps, trajectory.seed) if steps else []

    def steps(self, trajectory: Trajectory, train: TrainFilter) -> list[int]:
        """The steps with a write that is trained and can earn something, in order.

        At step 0 memory may write what an earlier episode of the run left to it.
        """
        calls = (call for call, _ in trained_completions(trajectory, train))
        return sorted({c.tag.step for c in calls if self.is_write(c.tag.path)})

    def is_write(self, path: str) -> bool:
        """Whether calls of `path` write."""
        return matches(path, self.calls)

    def advantages(self, group: Sequence[Paired], values: Values) -> list[Advantages | None]:
        """Per episode of a group what its writes earn; `None` where they earn what every other token does."""
        function = self.spec.function
        return [None] * len(group) if function is None else list(function(group, values))


def local(group: Sequence[Paired], values: Values) -> list[Advantages]:
    """Per write the mean advantage of its re-rolls with it, less that of those without, the two being one group.

    >>> returns = [WriteReturn(Plan(3, kept, i), r) for kept, rs in ((True, (3.0, 1.0)), (False, (1.0, 1.0)))
    ...            for i, r in enumerate(rs)]
    >>> local([Paired(0.0, tuple(returns))], lambda group: [r - sum(group) / len(group) for r in group])
    [{3: 1.0}]
    """
    found: list[Advantages] = []
    for episode in group:
        earned: Advantages = {}
        for step in sorted({r.plan.step for r in episode.returns}):
            mine = [r for r in episode.returns if r.plan.step == step and r.total is not None]
            kept, withheld = ([r.total for r in mine if r.plan.kept is kept] for kept in (True, False))
            earned[step] = 0.0
            if kept and withheld:
                scored = values([*kept, *withheld])  # type: ignore[list-item]  # none is None
                earned[step] = fmean(scored[: len(kept)]) - fmean(scored[len(kept) :])
        found.append(earned)
    return found


def ablation(group: Sequence[Paired], values: Values) -> list[Advantages]:
    """Per episode its advantage less that of its twin without memory, all episodes and twins being one group.

    >>> twin = (WriteReturn(Plan(EVERY, False), 1.0),)
    >>> ablation([Paired(3.0, twin), Paired(1.0, twin)], lambda group: [r - sum(group) / len(group) for r in group])
    [{-1: 2.0}, {-1: 0.0}]
    """
    twins = [next((r.total for r in e.returns if r.plan.step == EVERY), None) for e in group]
    places = [i for i, e in enumerate(group) if e.total is not None and twins[i] is not None]
    scored = values([*(group[i].total for i in places), *(twins[i] for i in places)])  # type: ignore[list-item]
    found: list[Advantages] = [{} for _ in group]
    for n, i in enumerate(places):
        found[i] = {EVERY: scored[n] - scored[n + len(places)]}
    return found


def _local_plan(rule: WriteRule, steps: Sequence[int], seed: int) -> list[Plan]:
    """Re-rolls with and without the writes drawn by the episode's own seed."""
    drawn = sorted(random.Random(f"writes {seed}").sample(list(steps), min(rule.points, len(steps))))
    return [Plan(step, kept, i) for step in drawn for kept in (True, False) for i in range(rule.rerolls)]


WRITE_CREDITS: dict[str, WriteCredit] = {
    spec.name: spec
    for spec in (
        WriteCredit("episode", "the episode's advantage, as of every other token", lambda *_: []),
        WriteCredit(
            "local",
            "re-rolls of the rest of the episode with the write, less re-rolls without it, from the same state",
            _local_plan,
            local,
            reads=("write_rerolls", "write_points"),
        ),
        WriteCredit(
            "ablation",
            "the episode less the same episode without any memory",
            lambda *_: [Plan(EVERY, kept=False)],
            ablation,
        ),
    )
}
"""Every estimator of a write by name."""


def write_credit(name: str) -> WriteCredit:
    """The row of `name`; `SpecError` with the nearest names if there is none."""
    if name not in WRITE_CREDITS:
        raise SpecError(f"unknown write_credit {name!r}{suggest(name, WRITE_CREDITS)}")
    return WRITE_CREDITS[name]
