"""Rows of known episodes."""

from __future__ import annotations

from typing import Any

import pytest

from agentspec.trajectory import Trajectory
from agentspec.types import Task
from eval.metrics import episode_row, number, outcome, primary_metric

METRICS = {
    "steps": 4,
    "return": 9.0,
    "invalid_actions": 1,
    "llm_calls": 8,
    "input_tokens": 400,
    "output_tokens": 40,
    "cached_tokens": 300,
    "cost": 0.02,
    "thinking_s": 2.0,
    "ended": "environment",
    "net_earnings": 9.0,
    "hourly_profit": 4.5,
    "deliveries": 2,
    "on_time": True,
    "pick_quality": None,
}


def trajectory(status: str = "completed", options: dict[str, Any] | None = None, **changes: Any) -> Trajectory:
    return Trajectory(Task("toy", 7, options or {}), {}, metrics=METRICS | changes, status=status, error="")


def test_a_row_divides_by_steps() -> None:
    row = episode_row(trajectory())
    assert row["seed"] == 7 and row["status"] == "completed" and row["ended"] == "environment"
    assert row["invalid_share"] == 0.25  # 1 / 4
    assert (row["input_tokens_per_step"], row["output_tokens_per_step"]) == (100.0, 10.0)  # 400 / 4, 40 / 4
    assert (row["calls_per_step"], row["thinking_s_per_step"], row["cost"]) == (2.0, 0.5, 0.02)
    assert (row["hourly_profit"], row["net_earnings"], row["deliveries"]) == (4.5, 9.0, 2.0)
    assert row["success"] is None
    assert row["env_metrics"] == {"on_time": True, "pick_quality": None}


def test_outcome_has_four_figures() -> None:
    assert outcome(trajectory()) == {"net_earnings": 9.0, "hourly_profit": 4.5, "steps": 4, "deliveries": 2}


def test_hourly_profit_counts_the_whole_shift_where_the_environment_did_not_say() -> None:
    # cut short after earning 9 dollars of a shift of 3 hours: 9 / 3
    assert episode_row(trajectory(options={"shift_hours": 3.0}, hourly_profit=None))["hourly_profit"] == 3.0
    assert episode_row(trajectory(shift_hours=2.0, hourly_profit=None))["hourly_profit"] == 4.5
    assert episode_row(trajectory(hourly_profit=None))["hourly_profit"] is None


def test_a_failed_episode_has_no_numbers() -> None:
    row = episode_row(trajectory("failed"))
    assert row["status"] == "failed" and row["net_earnings"] is None and row["steps"] is None


def test_an_episode_without_steps_has_no_shares() -> None:
    row = episode_row(trajectory(steps=0))
    assert row["invalid_share"] is None and row["thinking_s_per_step"] is None


@pytest.mark.parametrize(
    ("value", "expected"), [(True, 1.0), (3, 3.0), (float("nan"), None), ("3", None), (None, None)]
)
def test_number(value: Any, expected: float | None) -> None:
    assert number(value) == expected


def test_the_primary_metric_is_the_first_that_has_numbers() -> None:
    assert primary_metric([{"hourly_profit": None, "success": 0.0, "return": 1.0}]) == "success"
    assert primary_metric([{"hourly_profit": None}, {"hourly_profit": 1.0}]) == "hourly_profit"
    assert primary_metric([]) == "return"
