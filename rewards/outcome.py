"""Rewards for what an episode came to, paid at the last step: success, efficiency, the primary figure."""

from __future__ import annotations

from agentspec.metrics import declared, number
from agentspec.trajectory import Trajectory


def success(trajectory: Trajectory) -> tuple[float, ...]:
    """1 at the last step if the environment reports success, else 0.

    Raises:
        ValueError: an environment that does not report it.
    """
    achieved = number(trajectory.metrics.get("success"))
    if achieved is None:
        raise ValueError(
            f"the reward `success` needs metrics['success']; {trajectory.task.env} does not report it. Choose another "
            "reward (env, outcome)"
        )
    return _at_the_end(achieved, trajectory)


def efficiency(trajectory: Trajectory) -> tuple[float, ...]:
    """How short a success was, 0 to 1: the metric `efficiency` (MiniGrid), or `spl` (ALFRED, RoboTHOR).

    Raises:
        ValueError: an environment that reports neither.
    """
    names = [name for name in ("efficiency", "spl") if name in trajectory.metrics]
    if not names:
        raise ValueError(
            f"the reward `efficiency` needs metrics['efficiency'] or metrics['spl']; {trajectory.task.env} reports "
            "neither. Choose another reward (success, env, outcome)"
        )
    # Nothing is known of an episode that was cut short, or of a layout too large to search: no success, or no bonus.
    return _at_the_end(number(trajectory.metrics[names[0]]) or 0.0, trajectory)


def outcome(trajectory: Trajectory) -> tuple[float, ...]:
    """The figure that the environment declares first, at the last step; its negative where less is better.

    Raises:
        ValueError: an environment that declares no figure, or does not report it.
    """
    metrics = declared(trajectory.task.env)
    value = number(trajectory.metrics.get(metrics[0].name)) if metrics else None
    if value is None:
        what = f"does not report its {metrics[0].name}" if metrics else "declares no metrics"
        raise ValueError(f"the reward `outcome`: {trajectory.task.env} {what}; choose another reward (env)")
    return _at_the_end(value if metrics[0].higher_is_better else -value, trajectory)


def _at_the_end(value: float, trajectory: Trajectory) -> tuple[float, ...]:
    steps = len(trajectory.transitions)
    return (*(0.0,) * (steps - 1), value)[:steps]
