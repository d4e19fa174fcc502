"""A rollout that crashes, hangs or pays NaN touches no other: the run goes on, and healthy groups learn the same."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from agentspec.records.log import RunLog
from agentspec.trajectory import Trajectory, read_trajectories
from agentspec.types import Task
from tests.toy_env import ToyEnv
from tests.trainers.played import toy_tasks, toy_trainer
from trainers.audit import audit

TASKS, GROUP = 4, 4
MESSAGES = {
    "crash": "step raised RuntimeError: the toy broke",
    "hang": "step took longer than 2.0 s",
    "nan": "step returned reward nan",
    "reset": "reset raised ValueError: no map",
    "make": "make raised OSError: no simulator",
    "balance": "not finite",
}


class BrokenEnv(ToyEnv):
    """Faults that the toy does not have."""

    def reset(self, **settings: Any) -> Any:
        if self.fault == "reset":
            raise ValueError("no map")
        return super().reset(**settings)

    def step(self, action: str) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        if self.fault == "balance" and self.t > 1:
            info["balance"] = float("nan")
        return observation, reward, terminated, truncated, info


def worlds(fault: str, *seeds: int, times: int = 10**9) -> Any:
    """Environments of which the first ``times`` of each task in ``seeds`` are broken."""
    made: Counter[int] = Counter()

    def make(task: Task) -> Any:
        made[task.seed] += 1
        broken = task.seed in seeds and made[task.seed] <= times
        if broken and fault == "make":
            raise OSError("no simulator")
        return BrokenEnv(**task.options, fault=fault if broken else "")

    make.made = made  # type: ignore[attr-defined]
    return make


def train(folder: Path, make: Any, **changes: Any) -> tuple[list[Trajectory], list[dict[str, Any]]]:
    """One update of 4 groups of 4 rollouts: its episodes, and the rows of its receipt."""
    settings = {"per_device_train_batch_size": 8, "num_generations": GROUP, "max_steps": 1, "env_timeout_s": 2.0}
    trainer = toy_trainer(folder, toy_tasks(TASKS), make_env=make, **settings | changes)
    trainer.train()
    assert trainer.state.global_step == (settings | changes)["max_steps"]
    assert not [v for r in audit(folder) for v in r.violations]
    (record, *_) = RunLog(folder).read("updates.jsonl")
    return list(read_trajectories(folder / "trajectories" / "000000.jsonl")), record["rows"]


def group_rows(rows: list[dict[str, Any]], group: int) -> list[tuple[Any, ...]]:
    return sorted(
        (r["episode"], r["tokens"], r["trained"], r["advantage"], r["digest"])
        for r in rows
        if r["episode"] // GROUP == group
    )


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Rows of the update in which nothing failed."""
    return train(tmp_path_factory.mktemp("healthy"), worlds(""))[1]


@pytest.mark.parametrize("fault", MESSAGES)
def test_a_failing_group_leaves_the_others_untouched(tmp_path: Path, healthy: list[dict[str, Any]], fault: str) -> None:
    episodes, rows = train(tmp_path, worlds(fault, 1))
    order = [t.task.seed for t in episodes[::GROUP]]
    failing = order.index(1)
    for group in range(TASKS):
        if group != failing:
            assert group_rows(rows, group) == group_rows(healthy, group)
    assert group_rows(rows, failing) == []
    # Each failure stands in the log with its seed and what happened.
    failed = [t for t in episodes if not t.scorable]
    assert [t.task.seed for t in failed] == [1] * GROUP and len({t.seed for t in failed}) == GROUP
    assert all(MESSAGES[fault] in t.error for t in failed), failed[0].error
    (metrics,) = RunLog(tmp_path).read("metrics.jsonl")
    assert metrics["rollouts/unscorable"] == pytest.approx(GROUP / (GROUP * TASKS))


def test_one_failure_leaves_a_smaller_group(tmp_path: Path, healthy: list[dict[str, Any]]) -> None:
    """The baseline is that of the remaining three, and the other groups do not notice."""
    episodes, rows = train(tmp_path, worlds("crash", 2, times=1))
    group = [t.task.seed for t in episodes[::GROUP]].index(2)
    members = episodes[group * GROUP : (group + 1) * GROUP]
    assert sorted(t.scorable for t in members) == [False, True, True, True]
    scored = [float(t.metrics["return"]) for t in members if t.scorable]
    mean = sum(scored) / 3
    deviation = (sum((x - mean) ** 2 for x in scored) / 2) ** 0.5
    got = {r["episode"]: r["advantage"] for r in rows if r["episode"] // GROUP == group}
    for i, t in enumerate(members):
        if t.scorable:
            # Sample deviation + 1e-4, TRL's convention; equal returns give 0.
            expected = (t.metrics["return"] - mean) / (deviation + 1e-4) if deviation > 1e-6 else 0.0
            assert got[group * GROUP + i] == pytest.approx(expected)
        else:
            assert group * GROUP + i not in got
    for other in set(range(TASKS)) - {group}:
        assert group_rows(rows, other) == group_rows(healthy, other)


@pytest.mark.parametrize("retries", [0, 1, 3])
def test_retries_are_bounded(tmp_path: Path, retries: int) -> None:
    make = worlds("crash", 1)
    episodes, _ = train(tmp_path, make, retries=retries)
    assert make.made[1] == GROUP * (1 + retries)  # each rollout is tried once, and again at most `retries` times
    assert all(make.made[seed] == GROUP for seed in (0, 2, 3))
    assert sum(not t.scorable for t in episodes) == GROUP


def test_a_retry_heals_what_fails_once(tmp_path: Path, healthy: list[dict[str, Any]]) -> None:
    episodes, rows = train(tmp_path, worlds("crash", 1, times=GROUP), retries=2)
    assert all(t.scorable for t in episodes)
    group = [t.task.seed for t in episodes[::GROUP]].index(1)
    assert {r["episode"] // GROUP for r in rows} == set(range(TASKS))
    # A second attempt is another draw: its seeds are not those of the first.
    first = {r["digest"] for r in rows if r["episode"] // GROUP == group}
    assert first.isdisjoint({r["digest"] for r in healthy})


def test_a_round_in_which_everything_fails_changes_nothing(tmp_path: Path) -> None:
    """No rows, no gradient, no crash; the next round is played as usual."""
    episodes, rows = train(tmp_path, worlds("crash", 0, 1, 2, 3, times=GROUP), max_steps=2)
    assert rows == [] and not any(t.scorable for t in episodes)
    second = RunLog(tmp_path).read("updates.jsonl")[1]
    assert len(second["rows"]) > 0
    first = RunLog(tmp_path).read("metrics.jsonl")[0]
    assert first["grad_norm"] == 0.0 and first["rollouts/unscorable"] == 1.0
