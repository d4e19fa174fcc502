"""Estimators: how the returns of a group become advantages. One function and one row of `ESTIMATORS` adds one.

An estimator sees the scorable rollouts of one group and nothing else: no failed rollout, no token, no sequence can
change a baseline. One *per episode* gets returns and gives one number each; one *per step* gets rewards per step and
gives as many numbers. Plain floats in and out: whoever checks a run computes the very same numbers.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from itertools import accumulate, zip_longest
from typing import Any

from agentspec.actions import suggest
from agentspec.registry import SpecError

EPSILON = 1e-4
"""Added to a deviation before dividing by it, as TRL's synchronous trainer does."""

TOLERANCE = 1e-6
"""Values whose deviation is at most this are equal up to float noise: they carry no signal."""

Returns = Sequence[float]
Rewards = Sequence[Sequence[float]]
Anchors = Sequence[Sequence[Hashable]]


@dataclass(frozen=True)
class EstimatorSpec:
    """One row of the table.

    Args:
        function: per episode: returns (n,) -> advantages (n,); per step: rewards, ragged (n, steps) -> the same shape.
        zero_sum: whether the advantages of a group sum to zero (what an audit may expect of an honest run).
        needs: keyword arguments of `function` that come from the configuration (`gamma`, `gigpo_weight`) or from the
            episodes (`anchors`: per rollout and step the state in which the action was taken).
    """

    name: str
    function: Callable[..., Any]
    summary: str
    per_step: bool = False
    zero_sum: bool = True
    needs: tuple[str, ...] = ()


def grpo(returns: Returns) -> list[float]:
    """Centred by the group's mean, divided by its sample deviation (Shao et al., 2024; TRL's convention).

    >>> [round(a, 3) for a in grpo([15.0, 10.0, 5.0, 15.0])]
    [0.783, -0.261, -1.306, 0.783]
    """
    return _scaled([centred(returns)])[0]


def centred(returns: Returns) -> list[float]:
    """Less the group's mean (Dr. GRPO, Liu et al., 2025); exactly 0 where all are equal up to float noise."""
    if _deviation(returns) <= TOLERANCE:
        return [0.0] * len(returns)
    mean = math.fsum(returns) / len(returns)
    return [v - mean for v in returns]


def rloo(returns: Returns) -> list[float]:
    """Leave-one-out: each return minus the mean of the *others* (Ahmadian et al., 2024); a lone rollout gets 0.

    >>> rloo([1.0, 0.0])
    [1.0, -1.0]
    """
    n = len(returns)
    return [value * n / (n - 1) for value in centred(returns)] if n > 1 else [0.0] * n


def max_rl(returns: Returns) -> list[float]:
    """Centred, divided by the group's *mean* (Tajwar et al., 2026, arXiv 2602.02710): rare success counts 1 / p.

    >>> max_rl([1.0, 0.0, 0.0, 0.0])
    [3.0, -1.0, -1.0, -1.0]

    Raises:
        SpecError: a negative return (the method is defined for rates of success).
    """
    if any(value < -TOLERANCE for value in returns):
        raise SpecError(
            f"estimator 'max_rl' divides by the mean return: expected returns >= 0, got {list(returns)}; choose "
            "rewards that are never negative, or another estimator"
        )
    mean = math.fsum(returns) / len(returns) if returns else 0.0
    return [value / mean for value in centred(returns)] if mean > 0 else [0.0] * len(returns)


def discounted(rewards: Sequence[float], gamma: float) -> list[float]:
    """Discounted reward-to-go of each step.

    >>> discounted([1.0, 0.0, 2.0], 0.5)
    [1.5, 1.0, 2.0]
    """
    return list(accumulate(reversed(rewards), lambda later, reward: reward + gamma * later))[::-1]


def reward_to_go(rewards: Rewards, *, gamma: float = 1.0) -> list[list[float]]:
    """Discounted reward-to-go, centred per step over the group and scaled by the group's deviation.

    The baseline of step t is the mean over all rollouts; one that has ended earns nothing more, so it counts with 0.
    The deviation is the sample deviation of the centred values of all steps that were taken, about their own mean (it
    is not 0 where rollouts end at different times).
    """
    togo = [discounted(r, gamma) for r in rewards]
    if len(togo) < 2:
        return [[0.0] * len(g) for g in togo]
    means = [math.fsum(step) / len(togo) for step in zip_longest(*togo, fillvalue=0.0)]
    return _scaled([[v - m for v, m in zip(g, means, strict=False)] for g in togo])


def gigpo(rewards: Rewards, *, anchors: Anchors, gamma: float = 1.0, gigpo_weight: float = 1.0) -> list[list[float]]:
    """Group-in-group (Feng et al., 2025): the episode's advantage plus that of the step among equal states.

    Args:
        anchors: steps of the group with equal anchors form a step group, in which their rewards-to-go are normalised.
            A state met once has step advantage 0.
        gigpo_weight: of the step advantage.
    """
    togo = [discounted(r, gamma) for r in rewards]
    members: dict[Hashable, list[tuple[int, int]]] = defaultdict(list)
    for i, (values, states) in enumerate(zip(togo, anchors, strict=True)):
        if len(states) != len(values):
            raise ValueError(f"rollout {i} has {len(values)} steps and {len(states)} anchor states")
        for t, state in enumerate(states):
            members[state].append((i, t))
    result = [[base] * len(r) for base, r in zip(grpo(list(map(math.fsum, rewards))), rewards, strict=True)]
    for places in members.values():
        for (i, t), value in zip(places, grpo([togo[i][t] for i, t in places]), strict=True):
            result[i][t] += gigpo_weight * value
    return result


ESTIMATORS: dict[str, EstimatorSpec] = {
    spec.name: spec
    for spec in (
        EstimatorSpec("grpo", grpo, "(return - group mean) / sample deviation"),
        EstimatorSpec("centred", centred, "return - group mean (Dr. GRPO)"),
        EstimatorSpec("rloo", rloo, "return - mean of the others (leave-one-out)"),
        EstimatorSpec("max_rl", max_rl, "(return - group mean) / group mean, returns >= 0 (maximum likelihood)"),
        EstimatorSpec(
            "reward_to_go",
            reward_to_go,
            "reward-to-go of the step, centred per step over the group, / sample deviation of all these",
            per_step=True,
            zero_sum=False,
            needs=("gamma",),
        ),
        EstimatorSpec(
            "gigpo",
            gigpo,
            "`grpo` of the episode + that of the step's reward-to-go among equal states (group in group)",
            per_step=True,
            zero_sum=False,
            needs=("anchors", "gamma", "gigpo_weight"),
        ),
    )
}
"""Every estimator by name."""


def estimator(name: str) -> EstimatorSpec:
    """The row of `name`; `SpecError` with the nearest names if there is none."""
    if name not in ESTIMATORS:
        raise SpecError(f"unknown estimator {name!r}{suggest(name, ESTIMATORS)}")
    return ESTIMATORS[name]


def _scaled(values: Sequence[Sequence[float]]) -> list[list[float]]:
    """Divided by the sample deviation of all values; exactly 0 where all are equal up to float noise."""
    deviation = _deviation([v for several in values for v in several])
    divisor = deviation + EPSILON if deviation > TOLERANCE else math.inf
    return [[v / divisor for v in several] for several in values]


def _deviation(values: Sequence[float]) -> float:
    """Sample deviation; 0 for fewer than two values."""
    if len(values) < 2:
        return 0.0
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1))
