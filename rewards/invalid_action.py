"""A penalty per refused action; off unless a run weighs it in."""

from __future__ import annotations

from agentspec.trajectory import Trajectory


def invalid_action(trajectory: Trajectory) -> tuple[float, ...]:
    """-1 for every step whose text was no action or whose action the environment refused, else 0."""
    return tuple(-1.0 if not t.decision.valid or t.info.get("invalid") else 0.0 for t in trajectory.transitions)
