"""The reward registry and weighted sets of rewards."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from agentspec.actions import suggest
from agentspec.importing import import_name
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory

Reward = Callable[[Trajectory], tuple[float, ...]]


class NonFiniteRewardError(ValueError):
    """An episode's reward is NaN or infinite: this episode cannot be scored, whatever the others do."""


@dataclass(frozen=True)
class RewardEntry:
    """A registered reward: where it lives and what it pays."""

    target: str
    summary: str

    def load(self) -> Reward:
        """Import the function.

        Raises:
            SpecError: there is no such module, or no function of that name in it.
        """
        reward: Reward = import_name(self.target, "reward")
        return reward


REWARDS: dict[str, RewardEntry] = {
    "earning_delta": RewardEntry(
        "rewards.earning_delta:earning_delta", "change of the balance in dollars per step; the sum is net earnings"
    ),
    "invalid_action": RewardEntry("rewards.invalid_action:invalid_action", "-1 per step whose action was refused"),
    "delivery": RewardEntry("rewards.delivery:delivery", "shaping: +1 per order picked up, +1 per order delivered"),
    "env": RewardEntry("rewards.env:env_reward", "the environment's own reward"),
    "success": RewardEntry("rewards.outcome:success", "1 at the last step of an episode that succeeded"),
    "efficiency": RewardEntry(
        "rewards.outcome:efficiency", "how short a success was (efficiency or SPL), at the last step"
    ),
    "goal_progress": RewardEntry(
        "rewards.progress:goal_progress", "change of the share of goal conditions that are met"
    ),
    "geodesic_progress": RewardEntry(
        "rewards.progress:geodesic_progress", "metres come nearer over the shortest path's, clipped by metres moved"
    ),
    "outcome": RewardEntry("rewards.outcome:outcome", "the environment's primary figure, at the last step"),
    "reflection_gain": RewardEntry(
        "rewards.reflection_gain:reflection_gain", "return less that of the trial whose lesson was followed; else 0"
    ),
}


@dataclass(frozen=True)
class Score:
    """What an episode earned, computed once.

    Args:
        terms: each reward per step, unweighted.
        steps: their weighted sum per step.
    """

    terms: Mapping[str, tuple[float, ...]]
    steps: tuple[float, ...]

    @property
    def total(self) -> float:
        """The weighted return of the episode."""
        return math.fsum(self.steps)

    @property
    def sums(self) -> dict[str, float]:
        """Episode sum of each reward, unweighted."""
        return {name: math.fsum(values) for name, values in self.terms.items()}


def reward_entry(name: str) -> RewardEntry:
    """The entry of a registered name; of `module:function`, an entry for that function.

    Raises:
        SpecError: neither, with the nearest names.
    """
    if name not in REWARDS and ":" not in name:
        raise SpecError(f"unknown reward {name!r}{suggest(name, REWARDS)}")
    return REWARDS.get(name) or RewardEntry(name, "from outside this package")


class RewardSet:
    """A weighted sum of rewards.

    Args:
        weights: registered name, or `module:function`, -> weight. Default: `earning_delta` alone.

    Raises:
        SpecError: no reward, an unknown one, or a weight that is not finite.
    """

    def __init__(self, weights: Mapping[str, float] | None = None) -> None:
        if not isinstance(weights, Mapping | None):
            raise SpecError(f"rewards: expected {{name: weight}}, got {weights!r}")
        self.weights = {"earning_delta": 1.0} if weights is None else dict(weights)
        if not self.weights:
            raise SpecError(
                "rewards is {}, which pays nothing; name one (`rewards: {earning_delta: 1.0}`), or leave it out"
            )
        for name, weight in self.weights.items():
            if not isinstance(name, str):
                raise SpecError(f"rewards: expected the name of a reward, got {name!r}")
            if not isinstance(weight, int | float) or not math.isfinite(weight):
                raise SpecError(f"reward {name!r} has weight {weight}; expected a finite number")
        self._functions = {name: reward_entry(name).load() for name in self.weights}

    def score(self, trajectory: Trajectory) -> Score | None:
        """What the episode earned, every tuple as long as the episode; `None` if it failed and cannot be scored.

        Raises:
            NonFiniteRewardError: a reward that is not finite.
            ValueError: a reward that did not give one value per step.
        """
        if not trajectory.scorable:
            return None
        terms = {name: self._values(name, trajectory) for name in self._functions}
        columns = [[self.weights[name] * value for value in values] for name, values in terms.items()]
        return Score(terms, tuple(math.fsum(column) for column in zip(*columns, strict=True)))

    def _values(self, name: str, trajectory: Trajectory) -> tuple[float, ...]:
        values = tuple(self._functions[name](trajectory))
        if len(values) != len(trajectory.transitions):
            raise ValueError(
                f"reward {name!r} gave {len(values)} values for {len(trajectory.transitions)} steps of episode "
                f"{trajectory.episode}; expected one per step"
            )
        if not all(map(math.isfinite, values)):
            raise NonFiniteRewardError(
                f"reward {name!r} is not finite in episode {trajectory.episode}: {values}; the environment "
                "reported a number that is none"
            )
        return values
