"""Rewards that read what any environment declares: success, and its primary figure. Both are paid at the last step."""

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
