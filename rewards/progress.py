"""Dense rewards for household tasks: goal conditions met, and metres come nearer to the target."""

from __future__ import annotations

from typing import Any

from agentspec.envs.shared import come_nearer
from agentspec.trajectory import Trajectory


def goal_progress(trajectory: Trajectory) -> tuple[float, ...]:
    """Change of the share of goal conditions met (0 to 1) per step; what is undone is paid back.

    The sum is the share at the end: the first step is measured from 0, also where a condition held from the start (the
    same for all rollouts of a task).

    Raises:
        ValueError: an environment that does not report `info["goal_conditions"]`.
    """
    shares = [float(value) for value in _reports(trajectory, "goal_progress", "goal_conditions")]
    return tuple(after - before for before, after in zip([0.0, *shares], shares, strict=False))


def geodesic_progress(trajectory: Trajectory) -> tuple[float, ...]:
    """Metres that a step came nearer to where the target is seen, on foot, over the shortest path's length.

    Clipped to the metres that the step moved (`agentspec.envs.shared.come_nearer`). Paths shorter than a metre count as
    one. Steps beside the known floor pay 0.

    Raises:
        ValueError: an environment that does not report `info["geodesic"]`.
    """
    reports = _reports(trajectory, "geodesic_progress", "geodesic")
    level, walked = (reports[0]["start"], 0.0) if reports else (None, 0.0)  # metres that are paid for so far
    paid = []
    for report in reports:
        after, moved = report["left"], report["walked"] - walked
        level = after if level is None else level
        nearer = 0.0 if after is None else come_nearer(level, after, moved)
        level = level if level is None else level - nearer
        paid.append(nearer / max(report["shortest"], 1.0))
        walked = report["walked"]
    return tuple(paid)


def _reports(trajectory: Trajectory, reward: str, key: str) -> list[Any]:
    """What the environment reported after each step."""
    found = [t.info.get(key) for t in trajectory.transitions]
    if None in found:
        raise ValueError(
            f"the reward `{reward}` needs info[{key!r}] at every step; {trajectory.task.env} does not report it. "
            "Choose another reward (success, env, outcome)"
        )
    return found
