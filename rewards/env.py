"""The environment's own reward."""

from __future__ import annotations

from agentspec.trajectory import Trajectory


def env_reward(trajectory: Trajectory) -> tuple[float, ...]:
    """What ``env.step`` returned, per step."""
    return tuple(t.reward for t in trajectory.transitions)
