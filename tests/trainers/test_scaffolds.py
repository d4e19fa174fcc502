"""GRPO inside call-heavy scaffolds: three updates each, and the audit finds nothing to complain of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from tests.trainers.test_resume import trainer
from trainers.audit import audit

SPECS: list[dict[str, Any]] = [
    {"reasoning": {"name": "react", "thought_tokens": 4}},
    {"reasoning": {"name": "mad", "preset": "rl"}},
    {"reasoning": {"name": "plan_and_solve", "preset": "rl"}, "reflection": {"name": "self_refine", "preset": "rl"}},
    {"reasoning": "direct", "memory": {"name": "summary", "every": 2, "summary_tokens": 6}},
]


@pytest.mark.parametrize(
    "spec", SPECS, ids=lambda s: "+".join(str(v if isinstance(v, str) else v["name"]) for v in s.values())
)
@pytest.mark.parametrize("estimator", ["grpo", "reward_to_go"])
def test_three_updates_inside_a_scaffold(tmp_path: Path, spec: dict[str, Any], estimator: str) -> None:
    patterns = ["reasoning.*", *(["memory.summary"] if spec.get("memory") else [])]
    patterns += ["reflection.*"] if spec.get("reflection") else []
    run = trainer(
        tmp_path,
        agent={**spec, "sampling": {"max_tokens": 6}},
        train_calls=patterns,
        estimator=estimator,
        max_steps=3,
        save_steps=3,
    )
    run.train()
    receipts = list(audit(tmp_path))
    assert len(receipts) == 3
    assert [v for r in receipts for v in r.violations] == []
    assert all(r.trained == r.denominator > 0 for r in receipts)
