"""Rows of known episodes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from agentspec.episode import Job, Runner
from agentspec.metrics import (
    PLAIN,
    SUCCESS,
    Metric,
    columns,
    declared,
    episode_row,
    figures,
    number,
    outcome,
    primary_metric,
    typical_return,
)
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.toy_env import TOY

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


def trajectory(status: str = "completed", env: str = "deliverybench", **changes: Any) -> Trajectory:
    return Trajectory(Task(env, 7), {}, metrics=METRICS | changes, status=status, error="")


def test_a_row_divides_by_steps() -> None:
    row = episode_row(trajectory())
    assert row["seed"] == 7 and row["status"] == "completed" and row["ended"] == "environment"
    assert row["invalid_share"] == 0.25  # 1 / 4
    assert (row["input_tokens_per_step"], row["output_tokens_per_step"]) == (100.0, 10.0)  # 400 / 4, 40 / 4
    assert (row["calls_per_step"], row["thinking_s_per_step"], row["cost"]) == (2.0, 0.5, 0.02)
    assert (row["hourly_profit"], row["net_earnings"], row["deliveries"]) == (4.5, 9.0, 2.0)
    assert row["success"] is None
    assert row["env_metrics"] == {"on_time": True, "pick_quality": None}


def test_the_outcome_is_what_the_environment_declares_and_return_and_steps() -> None:
    assert outcome(trajectory()) == {
        "hourly_profit": 4.5,
        "net_earnings": 9.0,
        "deliveries": 2,
        "return": 9.0,
        "steps": 4,
    }
    # The toy declares two of these; what it does not declare is no outcome of its.
    assert list(outcome(trajectory(env=TOY))) == ["net_earnings", "deliveries", "return", "steps"]
    assert list(outcome(trajectory(env="CartPole-v1"))) == ["return", "steps"]
    assert outcome(trajectory(env="CartPole-v1", success=True))["success"] is True
    assert set(outcome(trajectory("failed")).values()) == {None}


def test_undeclared_figures_are_kept_aside() -> None:
    row = episode_row(trajectory(env=TOY))
    assert row["net_earnings"] == 9.0 and "hourly_profit" not in row
    assert row["env_metrics"] == {"on_time": True, "pick_quality": None, "hourly_profit": 4.5}


def test_an_episode_that_was_cut_short_has_the_declared_figures_too() -> None:
    [played] = Runner(AgentSpec.from_data({"reasoning": "random"}), max_steps=2).run(
        [Job(Task("deliverybench", 0, {"size": "tiny", "action_mode": "menu"}))]
    )
    row = episode_row(played)
    assert row["ended"] == "max_steps"
    assert all(row[metric.name] is not None for metric in declared("deliverybench"))


def test_figures_for_logs_are_numbers_that_were_reported() -> None:
    logged = figures(trajectory(pick_quality=0.5, deliveries=None))
    assert logged == {
        "hourly_profit": 4.5,
        "net_earnings": 9.0,
        "return": 9.0,
        "steps": 4.0,
        "invalid_actions": 1.0,
        "llm_calls": 8.0,
        "input_tokens": 400.0,
        "output_tokens": 40.0,
    }


def test_columns_are_declared_figures_then_the_scaffolds() -> None:
    rows = [
        {"env": "agentspec/DeliveryBench-v0", "net_earnings": 1.0, "steps": 3, "success": 1.0, "unknown": 2.0},
        {"env": "gone-v0", "return": 2.0, "hourly_profit": None},
    ]
    assert [m.name for m in columns(rows)] == ["net_earnings", "success", "return", "steps"]
    # Nobody knows the second environment any more; its figures are shown all the same.
    kept = [{"env": "gone-v0", "seed": 3, "rollout": 0, "laps": 4.0, "note": "x", "return": 1.0}]
    assert [m.heading for m in columns(kept)] == ["laps", "return"]
    assert [m.unit for m in declared("deliverybench")] == ["$/h", "$", ""]
    assert declared("gone-v0") == () and typical_return("gone-v0") == 1.0 and typical_return(TOY) == 25.0


def test_a_metric_describes_itself() -> None:
    profit = Metric("hourly_profit", "$/h")
    assert (profit.heading, profit.show(1.005)) == ("hourly profit ($/h)", "1.00")
    assert not PLAIN["steps"].higher_is_better and SUCCESS.higher_is_better
    with pytest.raises(ValueError, match="'hourly profit'; expected a name"):
        Metric("hourly profit")


def test_no_figure_of_an_environment_is_named_outside_it() -> None:
    """Evaluation, training and the command line read declarations; they know no environment's figures by name."""
    root = Path(__file__).parents[1]
    # DeliveryBench's; other worlds have figures whose names are ordinary words (`reward`, `spl`).
    ours = {m.name for m in declared("deliverybench")}
    assert ours >= {"hourly_profit", "net_earnings", "deliveries"}
    files = [p for part in ("eval", "trainers", "agentspec") for p in (root / part).rglob("*.py")]
    named = {
        f"{path.relative_to(root)}: {name}"
        for path in files
        if path.relative_to(root).parts[:2] != ("agentspec", "envs")
        and path.relative_to(root).as_posix() != "eval/paper.py"  # the paper's tables have names of their own
        for name in ours
        if re.search(rf"\b{name}\b", path.read_text())
    }
    assert not named


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
    rows: list[dict[str, Any]] = [{"env": "deliverybench", "hourly_profit": None, "success": 0.0, "return": 1.0}]
    assert primary_metric(rows).name == "success"
    assert primary_metric([*rows, {"env": "deliverybench", "hourly_profit": 1.0}]).name == "hourly_profit"
    assert primary_metric([]).name == "return"
