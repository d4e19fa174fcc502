"""Shaping towards deliveries, for policies that never earn by chance; off unless a run weighs it in."""

from __future__ import annotations

from agentspec.trajectory import Trajectory


def delivery(trajectory: Trajectory) -> tuple[float, ...]:
    """+1 per order picked up and +1 per order delivered in a step, from the environment's ``info["events"]``."""
    return tuple(
        float(sum(event in ("picked_up", "delivered") for event in t.info.get("events", ())))
        for t in trajectory.transitions
    )
