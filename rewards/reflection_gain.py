"""What a lesson was worth: the change of return from the trial it was drawn from to the trial that followed it."""

from __future__ import annotations

from agentspec.trajectory import Trajectory


def reflection_gain(trajectory: Trajectory) -> tuple[float, ...]:
    """The environment's reward per step, the first less the return before the lesson: the sum is the change of return.

    All 0 in an episode without a lesson (``reflection/return_before`` of :mod:`agentspec.reflection.retroformer`).
    """
    before = trajectory.metrics.get("reflection/return_before")
    if before is None:
        return (0.0,) * len(trajectory.transitions)
    return tuple(t.reward - (float(before) if i == 0 else 0.0) for i, t in enumerate(trajectory.transitions))
