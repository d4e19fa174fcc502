"""The study's report: gains paired by task, per training seed and over all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("trl")

from agentspec.registry import SpecError
from recipes.common import CONFIGS
from recipes.learning_study import check, gains
from trainers.arguments import parse_config


def rows(policy: str, scaffold: str, values: list[float]) -> list[dict[str, object]]:
    return [
        {
            "env": "deliverybench",
            "policy": policy,
            "scaffold": scaffold,
            "tasks": "t",
            "task": f"t{i}",
            "status": "completed",
            "net_earnings": v,
        }
        for i, v in enumerate(values)
    ]


def test_gains_are_paired_by_task() -> None:
    played = [
        *rows("start", "bare", [1.0, 2.0, 3.0, 4.0]),
        *rows("grpo-s0", "bare", [3.0, 4.0, 5.0, 6.0]),  # +2 on every task: no spread
        *rows("grpo-s1", "bare", [5.0, 6.0, 7.0, 8.0]),  # +4
        *rows("grpo-s2", "bare", [4.0, 5.0, 6.0, 7.0]),  # +3
    ]
    text = gains(played, {"grpo": [0, 1, 2]}, {"grpo": "bare"})
    line = next(line for line in text.splitlines() if line.startswith("| grpo"))
    cells = [c.strip() for c in line.strip("|").split("|")]
    assert cells[1] == "bare (its own)"
    assert cells[2].startswith("2.50 ") and cells[3].startswith("5.50 ")
    # Gains of the runs 2, 4, 3: 3 -+ 4.3027 / sqrt 3, t = 3 sqrt 3 with 2 degrees of freedom: p = .0351
    assert cells[4:7] == ["3.00 [0.52, 5.48]", "0.035", "gain"]
    assert cells[7] == "2.00 [2.00, 2.00], 4.00 [4.00, 4.00], 3.00 [3.00, 3.00]"
    assert cells[8] == "4"


def test_one_run_says_nothing_about_its_recipe() -> None:
    played = [*rows("start", "bare", [1.0, 2.0]), *rows("grpo-s0", "bare", [3.0, 4.0])]
    line = gains(played, {"grpo": [0]}, {"grpo": "bare"}).splitlines()[-1]
    # Two seeds, both +2: of four flips two are as far, p = .5
    assert "| 0.500 | tie |" in line


def test_a_task_that_failed_for_one_run_counts_for_none() -> None:
    played = [*rows("start", "bare", [0.0, 0.0]), *rows("grpo-s0", "bare", [1.0, 9.0])]
    played[-1] = {**played[-1], "status": "failed"}
    line = gains(played, {"grpo": [0]}, {"grpo": "bare"}).splitlines()[-1]
    assert "| 1.00 |" in line and line.endswith("| 1 |")


def test_the_shipped_study_compares_like_with_like() -> None:
    grpo, supo = (parse_config([], default=CONFIGS / f"study_{name}.yaml") for name in ("grpo", "supo"))
    grpo.check()
    supo.check()
    check({"grpo": grpo, "supo": supo})
    assert grpo.spec == replace(supo.spec, memory=grpo.spec.memory)
    supo.eval_tasks = 4
    with pytest.raises(SpecError, match="eval_tasks is 4 in supo and 32 in grpo"):
        check({"grpo": grpo, "supo": supo})


def test_curves_are_drawn(tmp_path: Path) -> None:
    from eval.plots import learning_curves

    run = [{"step": s, "reward": float(s)} for s in (1, 2, 3)]
    assert learning_curves({"grpo": [run, run[:2]], "empty": [[]]}, tmp_path / "c.png")
    assert (tmp_path / "c.png").stat().st_size > 1000
    assert not learning_curves({"grpo": [[]]}, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
