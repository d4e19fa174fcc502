"""A run is a function of its configuration, not of how fast environments are or how requests are batched."""

from __future__ import annotations

import random
import time
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from agentspec.trajectory import read_trajectories
from agentspec.types import Task
from tests.toy_env import ToyEnv
from tests.trainers.played import toy_trainer


class UnevenEnv(ToyEnv):
    """Each step takes a time of its own."""

    def step(self, action: str) -> Any:
        time.sleep(random.SystemRandom().choice([0.0, 0.002, 0.02]))
        return super().step(action)


def sampled(folder: Path) -> list[Any]:
    """Every completion of a run, with the log-probabilities it was sampled at."""
    files = sorted((folder / "trajectories").glob("*.jsonl"))
    return [[call.completions for call in t.calls] for file in files for t in read_trajectories(file)]


def trained(folder: Path, **changes: Any) -> dict[str, torch.Tensor]:
    def make_env(task: Task) -> ToyEnv:
        return UnevenEnv(**task.options)

    run = toy_trainer(
        folder, make_env=make_env, agent={"reasoning": "react", "sampling": {"max_tokens": 12}}, **changes
    )
    run.train()
    return {name: p.detach().clone() for name, p in run.model.named_parameters()}


def test_weights_do_not_depend_on_timing_or_batching(tmp_path: Path) -> None:
    start = trained(tmp_path / "start", learning_rate=0.0)
    expected = trained(tmp_path / "closed", batching="closed")
    assert any(not torch.equal(start[n], expected[n]) for n in start) and sampled(tmp_path / "closed")
    for i, batching in enumerate(("auto", "auto", "continuous")):
        got = trained(tmp_path / f"{batching}{i}", batching=batching)
        assert all(torch.equal(got[n], expected[n]) for n in expected), batching
        assert sampled(tmp_path / f"{batching}{i}") == sampled(tmp_path / "closed")
