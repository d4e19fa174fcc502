"""The reward registry and weighted sets of rewards."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from agentspec.actions import suggest
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
        """Import the function."""
        module, _, name = self.target.partition(":")
        reward: Reward = getattr(importlib.import_module(module), name)
        return reward


REWARDS: dict[str, RewardEntry] = {
    "earning_delta": RewardEntry(
        "rewards.earning_delta:earning_delta", "change of the balance in dollars per step; the sum is net earnings"
    ),
    "invalid_action": RewardEntry("rewards.invalid_action:invalid_action", "-1 per step whose action was refused"),
    "delivery": RewardEntry("rewards.delivery:delivery", "shaping: +1 per order picked up, +1 per order delivered"),
    "env": RewardEntry("rewards.env:env_reward", "the environment's own reward"),
    "reflection_gain": RewardEntry(
        "rewards.reflection_gain:reflection_gain", "return less that of the trial whose lesson was followed; else 0"
    ),
}


class RewardSet:
    """A weighted sum of rewards.

    Args:
        weights: registered name -> weight. Default: ``earning_delta`` alone.
    """

    def __init__(self, weights: Mapping[str, float] | None = None) -> None:
        self.weights = dict(weights or {"earning_delta": 1.0})
        for name in self.weights:
            if name not in REWARDS:
                raise SpecError(f"unknown reward {name!r}{suggest(name, REWARDS)}")
        self._functions = {name: REWARDS[name].load() for name in self.weights}

    def terms(self, trajectory: Trajectory) -> dict[str, float] | None:
        """Episode sum of each reward, unweighted; ``None`` if the episode is unscorable.

        Raises:
            NonFiniteRewardError: a reward that is not finite.
        """
        steps = self.steps(trajectory)
        return None if steps is None else {name: math.fsum(values) for name, values in steps.items()}

    def steps(self, trajectory: Trajectory) -> dict[str, tuple[float, ...]] | None:
        """Each reward per step, unweighted, every tuple as long as the episode; ``None`` if unscorable."""
        if not trajectory.scorable:
            return None
        result = {}
        for name, function in self._functions.items():
            values = function(trajectory)
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
            result[name] = values
        return result

    def total(self, trajectory: Trajectory) -> float | None:
        """The weighted episode return; ``None`` if unscorable."""
        terms = self.terms(trajectory)
        return None if terms is None else math.fsum(self.weights[name] * value for name, value in terms.items())
