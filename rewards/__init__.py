"""Rewards: from an episode to numbers, one per step and their sum per episode.

A reward is a function `Trajectory -> tuple[float, ...]` with one value per step. A run uses a weighted set of them;
each is logged under its own name. An episode that failed has no score at all (`None`), never zero.
"""

from rewards.base import REWARDS, RewardEntry, RewardSet, Score

__all__ = ["REWARDS", "RewardEntry", "RewardSet", "Score"]
