"""Summaries and tables of rows written by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from eval.plots import matrix_heatmap, reward_curve, running_mean
from eval.statistics import Estimate
from eval.tables import differences, differences_caption, markdown, show, summarise, table, write_report


def row(policy: str, task: str, profit: float | None, *, scaffold: str = "plain", **changes: Any) -> dict[str, Any]:
    return {
        "env": "deliverybench",
        "tasks": "city",
        "policy": policy,
        "scaffold": scaffold,
        "task": task,
        "rollout": 0,
        "status": "completed",
        "ended": "environment",
        "hourly_profit": profit,
        "steps": 10,
    } | changes


ROWS = [
    row("base", "a", 1.0),
    row("base", "b", 3.0),
    row("base", "c", None, status="failed"),
    row("tuned", "a", 5.0, rollout=0),
    row("tuned", "a", 7.0, rollout=1),
    row("tuned", "b", 8.0, ended="budget"),
    row("tuned", "c", 100.0),
]


def test_summaries_count_what_they_leave_out() -> None:
    base, tuned = summarise(ROWS)
    assert (base.episodes, base.failed, base.cut_short) == (3, 1, 0)
    assert (tuned.episodes, tuned.failed, tuned.cut_short) == (4, 0, 1)
    assert base.estimates["hourly_profit"].mean == 2.0  # (1 + 3) / 2: the failed one is left out
    # Rollouts of a task are averaged first: ((5 + 7) / 2 + 8 + 100) / 3 = 38
    assert tuned.estimates["hourly_profit"].mean == pytest.approx(38.0)
    assert tuned.estimates["hourly_profit"].n == 3
    assert "cost" not in base.estimates


def test_differences_are_paired_by_task() -> None:
    [difference] = differences(ROWS, "hourly_profit")
    # Tasks a and b: 6 - 1 = 5 and 8 - 3 = 5; task c has no number for the baseline.
    assert difference == {
        "tasks": "city",
        "scaffold": "plain",
        "policy": "tuned",
        "baseline": "base",
        "mean": 5.0,
        "low": 5.0,
        "high": 5.0,
        "p": 0.5,  # of the four flips of (5, 5), two are as far from 0
        "tie": True,
        "n": 2,
        "unit": "seed",
        "note": "this checkpoint only",
    }
    assert differences(ROWS, "hourly_profit", by="scaffold") == []
    with pytest.raises(ValueError, match="'policy' or 'scaffold'"):
        differences(ROWS, "hourly_profit", by="task")


def test_markdown_has_matrix_details_and_differences() -> None:
    rows = [*ROWS, row("base", "a", 2.0, scaffold="react|x"), row("base", "b", 5.0, scaffold="react|x")]
    text = markdown(rows)
    assert "## city: hourly profit ($/h)" in text
    assert "| policy | plain | react\\|x |" in text
    # t(1, .975) = 12.706: 2 -+ 12.706 * 1 and 3.5 -+ 12.706 * 1.5; t(2, .975) = 4.3027: 38 -+ 4.3027 * 31.01
    assert "| base | 2.00 [-10.71, 14.71] | 3.50 [-15.56, 22.56] |" in text
    assert "| tuned | 38.00 [-95.41, 171.41] | – |" in text
    assert "| base | plain | 1 | 3 | 1 | 0 | 2.00 | 10.0 |" in text
    assert "| plain | tuned - base | 5.00 [5.00, 5.00] | 0.500 | tie | 2 seeds |" in text
    # by scaffold: 2 - 1 = 1 and 5 - 3 = 2
    assert "| base | react\\|x - plain | 1.50 [-4.85, 7.85] | 0.500 | tie | 2 seeds |" in text
    assert markdown([]) == "No episodes.\n"


def test_show_and_table() -> None:
    assert show(None, 2) == "–"
    assert show(Estimate(1.234, math.nan, math.nan, 1), 1) == "1.2"
    assert table(["a"], [["b"]]) == ["| a |", "| --- |", "| b |"]


def test_the_report_is_written_beside_the_rows(tmp_path: Path) -> None:
    write_report(ROWS, tmp_path)
    data = json.loads((tmp_path / "summary.json").read_text())
    assert data["level"] == 0.95 and data["cells"][0]["estimates"]["hourly_profit"]["mean"] == 2.0
    assert (tmp_path / "results.md").read_text() == markdown(ROWS)


def test_running_mean() -> None:
    # 1; (1+3)/2; (3+5)/2; (5+7)/2
    assert running_mean(np.array([1.0, 3.0, 5.0, 7.0]), 2).tolist() == [1.0, 2.0, 4.0, 6.0]


def test_plots_are_pictures(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    rows = [{"step": i, "reward": i / 10, "reward_std": 0.1} for i in range(8)] + [{"step": 8, "train_runtime": 1.0}]
    assert reward_curve(rows, tmp_path / "curve.png")
    two = [*ROWS, row("base", "a", 2.0, tasks="town")]
    assert matrix_heatmap(summarise(two), tmp_path / "matrix.png", metric="hourly_profit")
    for name in ("curve.png", "matrix.png"):
        with Image.open(tmp_path / name) as image:
            assert image.width > 300 and image.height > 200
    assert not reward_curve([{"step": 1, "loss": 2.0}], tmp_path / "none.png")
    assert not matrix_heatmap([], tmp_path / "none.png") and not (tmp_path / "none.png").exists()
    with pytest.raises(ValueError, match="unknown metric"):
        matrix_heatmap(summarise(ROWS), tmp_path / "none.png", metric="profit")


def test_the_report_names_the_world_and_its_rules() -> None:
    row = {
        "tasks": "t",
        "policy": "p",
        "scaffold": "s",
        "task": "a",
        "status": "completed",
        "env": "deliverybench",
        "options": {"size": "tiny"},
        "env_metrics": {"rules": "fair"},
        "net_earnings": 1.0,
        "return": 1.0,
    }
    assert "World: deliverybench (size tiny); rules: fair." in markdown([row])


def test_a_table_with_too_few_tasks_says_that_it_can_only_tie() -> None:
    policies = "abcdefgh"
    rows = [row(p, f"t{i}", 10.0 * k + i) for k, p in enumerate(policies) for i in range(8)]
    compared = differences(rows, "hourly_profit")
    assert all(r["tie"] for r in compared)  # 7 x 2^-7: above 0.05, though every task says the same
    assert "it takes 9 tasks" in differences_caption(compared) and "it takes 9 tasks" in markdown(rows)
    rows = [row(p, f"t{i}", 10.0 * k + i) for k, p in enumerate(policies) for i in range(9)]
    compared = differences(rows, "hourly_profit")
    assert not any(r["tie"] for r in compared) and "it takes" not in differences_caption(compared)


def test_a_policy_without_a_score_has_no_differences() -> None:
    rows = [row("base", f"t{i}", None, status="unplayed") for i in range(8)]
    rows += [row("tuned", f"t{i}", 5.0 + i) for i in range(8)]
    [compared] = differences(rows, "hourly_profit")
    assert (compared["mean"], compared["p"], compared["n"]) == (None, None, 0) and compared["tie"]
    assert "| plain | tuned - base | – | – | \N{EN DASH} | 0 seeds |" in markdown(rows)
