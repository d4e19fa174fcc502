"""From an episode to one flat row of numbers: what it earned, how it acted, what it cost.

The environment reports what was achieved (earnings, deliveries, success), the scaffold what it took (steps, tokens,
seconds of the model, dollars). A failed episode has a row too, with its error and without numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agentspec.trajectory import Trajectory, jsonable


@dataclass(frozen=True)
class Metric:
    """A column: name in the rows, heading in tables, digits after the point, and whether more is better."""

    name: str
    heading: str
    digits: int = 2
    higher_is_better: bool = True


METRICS: tuple[Metric, ...] = (
    Metric("hourly_profit", "hourly profit ($/h)"),
    Metric("net_earnings", "net earnings ($)"),
    Metric("success", "success"),
    Metric("return", "return"),
    Metric("deliveries", "deliveries"),
    Metric("steps", "steps", 1, higher_is_better=False),
    Metric("invalid_share", "invalid", 3, higher_is_better=False),
    Metric("input_tokens_per_step", "input tokens/step", 0, higher_is_better=False),
    Metric("output_tokens_per_step", "output tokens/step", 1, higher_is_better=False),
    Metric("calls_per_step", "calls/step", 2, higher_is_better=False),
    Metric("thinking_s_per_step", "thinking (s/step)", 3, higher_is_better=False),
    Metric("cost", "cost ($)", 4, higher_is_better=False),
)
"""All columns in the order of tables; the first that a set of rows has is its primary one."""

BY_NAME = {m.name: m for m in METRICS}

CUT_SHORT = ("budget", "context")
"""Ends of an episode that the scaffold brought about, not the environment: counted beside the means."""


def episode_row(trajectory: Trajectory) -> dict[str, Any]:
    """The figures of one episode.

    ``hourly_profit`` (dollars per hour of the *whole* shift, as the paper counts it) is the environment's; where an
    episode was cut short before the environment reported it, it is net earnings over the task's ``shift_hours``.
    ``thinking_s_per_step`` is wall-clock time of the model calls, in seconds. Numbers that an environment does not
    report are ``None``; all of its own figures stand under ``env_metrics``.
    """
    task, m = trajectory.task, trajectory.metrics
    row: dict[str, Any] = {
        "env": task.env,
        "task": task.key,
        "seed": task.seed,
        "options": jsonable(task.options),
        "rollout": trajectory.rollout,
        "status": trajectory.status,
        "error": trajectory.error,
        "ended": m.get("ended", ""),
    }
    if not trajectory.scorable:
        return row | {metric.name: None for metric in METRICS}
    steps = number(m.get("steps")) or 0.0
    row |= {
        "hourly_profit": _hourly_profit(trajectory),
        "net_earnings": number(m.get("net_earnings")),
        "success": number(m.get("success")),
        "return": number(m.get("return")),
        "deliveries": number(m.get("deliveries")),
        "steps": int(steps),
        "invalid_share": _per(m.get("invalid_actions"), steps),
        "input_tokens_per_step": _per(m.get("input_tokens"), steps),
        "output_tokens_per_step": _per(m.get("output_tokens"), steps),
        "calls_per_step": _per(m.get("llm_calls"), steps),
        "thinking_s_per_step": _per(m.get("thinking_s"), steps),
        "cost": number(m.get("cost")),
        "input_tokens": m.get("input_tokens"),
        "output_tokens": m.get("output_tokens"),
        "thinking_s": m.get("thinking_s"),
    }
    known = set(row) | {"invalid_actions", "llm_calls", "cached_tokens"}
    row["env_metrics"] = {k: jsonable(v) for k, v in m.items() if k not in known}
    return row


def number(value: Any) -> float | None:
    """``value`` as a finite float (booleans as 0 and 1), or ``None``."""
    if not isinstance(value, (bool, int, float)) or not math.isfinite(value):
        return None
    return float(value)


def _per(total: Any, steps: float) -> float | None:
    value = number(total)
    return None if value is None or steps == 0 else value / steps


def _hourly_profit(trajectory: Trajectory) -> float | None:
    reported = number(trajectory.metrics.get("hourly_profit"))
    if reported is not None:
        return reported
    earned = number(trajectory.metrics.get("net_earnings"))
    hours = number(trajectory.metrics.get("shift_hours")) or number(trajectory.task.options.get("shift_hours"))
    return None if earned is None or not hours else earned / hours


def outcome(trajectory: Trajectory) -> dict[str, Any]:
    """The four figures that ``agentspec run --json`` ends with; ``None`` where the environment has none."""
    row = episode_row(trajectory)
    return {
        "net_earnings": row["net_earnings"],
        "hourly_profit": row["hourly_profit"],
        "steps": row["steps"],
        "deliveries": None if row["deliveries"] is None else int(row["deliveries"]),
    }


def primary_metric(rows: list[Mapping[str, Any]]) -> str:
    """The first column of :data:`METRICS` that any of the rows has a number for (``"return"`` if none has)."""
    return next((m.name for m in METRICS if any(r.get(m.name) is not None for r in rows)), "return")
