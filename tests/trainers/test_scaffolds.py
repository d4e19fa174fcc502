"""GRPO inside call-heavy scaffolds: three updates each, and the audit finds nothing to complain of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from tests.trainers.builders import CPU_RUN
from tests.trainers.test_resume import trainer
from trainers.audit import audit
from trainers.config import ScaffoldConfig

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


@pytest.mark.parametrize("groups", ["across", "within"])
def test_a_group_over_two_scaffolds(tmp_path: Path, groups: str) -> None:
    """Rollouts or tasks are dealt out; a task's are one group all the same, and the audit makes the same of them."""
    run = trainer(
        tmp_path,
        agent={"sampling": {"max_tokens": 6}},
        scaffolds=[{"memory": ["none", "base"], "layout": "snapshot"}],
        scaffold_groups=groups,
        max_steps=2,
        save_steps=2,
    )
    run.train()
    receipts = list(audit(tmp_path))
    assert [r.violations for r in receipts] == [[], []]
    group = run.args.num_generations
    played = [(t.rollout if groups == "across" else t.task.seed, t.spec["memory"]) for t in run.last_episodes]
    assert all(memory == ("none", "base")[number % 2] for number, memory in played) and group == 2
    rounds = RunLog(tmp_path).read("updates.jsonl")
    for start in range(0, len(played), group):  # the advantage of a group's episodes, over both scaffolds, sums to 0
        by_episode = {row["episode"]: row["advantage"] for row in rounds[-1]["rows"]}
        assert abs(sum(by_episode.get(i, 0.0) for i in range(start, start + group))) < 1e-6


@pytest.mark.parametrize(
    "more", [{"scaffolds": [{"memory": ["none", "base", "summary"]}]}, {"agent": {"scope": "run"}}], ids=["3", "run"]
)
def test_groups_that_cannot_be_dealt_out(tmp_path: Path, more: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match=r"scaffolds: .* takes a multiple of them"):
        trainer(tmp_path, **{"scaffolds": [{"memory": ["none", "base"]}], **more})


def test_what_is_held_out_is_refused(tmp_path: Path) -> None:
    base: dict[str, Any] = {
        "output_dir": str(tmp_path),
        "num_generations": 2,
        "held_out": [{"memory": "base"}],
        **CPU_RUN,
    }
    with pytest.raises(SpecError, match=r"held_out: .* is in the mixture"):
        ScaffoldConfig(**base, scaffolds=[{"memory": ["none", "base"]}]).check()
    with pytest.raises(SpecError, match=r"held_out is .* there is one scaffold"):
        ScaffoldConfig(**base).check()
