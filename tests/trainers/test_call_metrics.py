"""Metrics per kind of call: exact numbers, and shares that add up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from agentspec.records.log import RunLog
from tests.trainers.builders import call, episode
from tests.trainers.test_resume import trainer
from trainers.call_metrics import CallMetrics
from trainers.micro_batches import collate
from trainers.sequences import Row, TrainFilter, build_sequences

ACT, SUM = "reasoning.direct/act", "memory.summary/summarise"


def rows() -> list[Row]:
    """Two actions of two tokens in one row (advantage 0.5 each), a summary of one token in another (-3)."""
    calls = [
        call(0, [1, 2], [5, 6], module="reasoning.direct", purpose="act"),
        call(1, [1, 2, 5, 6, 3], [7, 8], module="reasoning.direct", purpose="act"),
        call(2, [9, 9], [4], module="memory.summary", purpose="summarise"),
    ]
    first, second = build_sequences(episode(calls), TrainFilter(("*",)))
    return [Row(first, 0.5, 0), Row(second, -3.0, 0)]


def test_exact_numbers() -> None:
    batch = collate(rows(), pad=0)
    computed = batch["tool_mask"]
    entropies = torch.arange(12.0).view(2, 6) * computed
    clipped = torch.zeros(2, 6, dtype=torch.bool)
    clipped[0, 1] = True  # the first trained token of the first row stands at position 2
    metrics = CallMetrics()
    metrics.add(rows(), entropies, clipped)
    got = metrics.flush()
    assert got[f"calls/{ACT}/tokens"] == 4 and got[f"calls/{SUM}/tokens"] == 1
    assert got[f"calls/{ACT}/advantage_mass"] == pytest.approx(2.0 / 5.0)
    assert got[f"calls/{SUM}/advantage_mass"] == pytest.approx(3.0 / 5.0)
    assert got[f"calls/{ACT}/entropy"] == pytest.approx((1 + 2 + 4 + 5) / 4)
    assert got[f"calls/{SUM}/entropy"] == pytest.approx(7.0)
    assert got[f"calls/{ACT}/clip_share"] == 0.25 and got[f"calls/{SUM}/clip_share"] == 0.0
    assert metrics.flush() == {}


def test_ranks_are_added_up() -> None:
    nothing = torch.zeros(2, 6)
    alone, first, second = CallMetrics(), CallMetrics(), CallMetrics()
    for metrics, parts in ((alone, rows() + rows()), (first, rows()), (second, rows())):
        for start in range(0, len(parts), 2):
            metrics.add(parts[start : start + 2], nothing, nothing.bool())
    other: list[Any] = []
    second.flush(lambda local: other.extend(local) or [])  # type: ignore[func-returns-value]
    assert first.flush(lambda local: local + other) == alone.flush()


def test_they_agree_with_the_whole_update(tmp_path: Path) -> None:
    """Token-weighted means over the paths are TRL's figures for the update; several iterations make ratios move."""
    run = trainer(
        tmp_path,
        agent={"reasoning": "direct", "memory": {"name": "summary", "every": 2, "summary_tokens": 6}},
        train_calls=["reasoning.*", "memory.summary"],
        gradient_accumulation_steps=1,
        per_device_train_batch_size=4,
        num_generations=4,
        steps_per_generation=1,
        num_iterations=3,
        epsilon=1e-4,
        max_steps=6,
        learning_rate=1e-2,
    )
    run.train()
    clipped = 0.0
    for record in RunLog(tmp_path).read("metrics.jsonl"):
        paths = {k.split("/", 1)[1].rpartition("/")[0] for k in record if k.startswith("calls/") and "entropy" in k}
        assert len(paths) == 2
        tokens = {p: record[f"calls/{p}/tokens"] for p in paths}
        for name, whole in (("entropy", "entropy"), ("clip_share", "clip_ratio/region_mean")):
            mean = sum(tokens[p] * record[f"calls/{p}/{name}"] for p in paths) / sum(tokens.values())
            assert mean == pytest.approx(record[whole], abs=1e-5)
        assert sum(record[f"calls/{p}/advantage_mass"] for p in paths) == pytest.approx(1.0) or not record["reward_std"]
        clipped += record["clip_ratio/region_mean"]
    assert clipped > 0
