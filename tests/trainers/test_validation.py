"""Evaluation while training: it reports what playing the held-out tasks gives, changes nothing, keeps the best."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from datasets import Dataset
from safetensors.torch import load_file

from agentspec.episode import Job, Runner
from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from rewards import RewardSet
from tests.toy_env import TOY
from tests.trainers.builders import call, episode
from tests.trainers.test_resume import trainer, weights
from trainers.config import ScaffoldConfig
from trainers.credit import ScoredEpisode
from trainers.rollouts import task_rows
from trainers.validation import validate, validation_scaffolds

HELD_OUT = [Task(TOY, 10_000 + i, {"steps": 3, "menu": True}, "validation") for i in range(4)]
VALIDATED: dict[str, Any] = {"eval_strategy": "steps", "eval_steps": 1}


def validating(folder: Path, **changes: Any) -> Any:
    return trainer(folder, held_out=HELD_OUT, **VALIDATED | changes)


def test_training_goes_on_as_if_nothing_had_been_evaluated(tmp_path: Path) -> None:
    plain = trainer(tmp_path / "plain")
    plain.train()
    run = validating(tmp_path / "validated", validation_specs=[{"reasoning": "direct", "layout": "snapshot"}])
    run.train()
    expected, got = weights(plain), weights(run)
    assert all(torch.equal(expected[n], got[n]) for n in expected)
    logs = [
        [{k: v for k, v in r.items() if "time" not in k} for r in RunLog(tmp_path / name).read("metrics.jsonl")]
        for name in ("plain", "validated")
    ]
    assert logs[0] == logs[1]
    evaluations = RunLog(tmp_path / "validated").read("evaluations.jsonl")
    assert [r["step"] for r in evaluations] == [1, 2, 3, 4]
    (other,) = (p for p in validation_scaffolds(run.args) if p)
    assert all({"eval_reward", "eval_steps", f"eval_{other}reward"} <= set(r) for r in evaluations)
    # The last record is what the final weights earn, played here by hand.
    spec = replace(run.args.spec, sampling=replace(run.args.spec.sampling, temperature=0.0))
    run.llm.invalidate()
    played = Runner(spec, run.llm).run([Job(t, 0, run.args.seed) for t in HELD_OUT])
    assert evaluations[-1]["eval_reward"] == pytest.approx(sum(t.metrics["return"] for t in played) / len(played))


def test_the_best_checkpoint_is_kept_and_can_be_the_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scores = iter([1.0, 3.0, 2.0, 0.0])
    monkeypatch.setattr("trainers.validation.validate", lambda *args, **kwargs: {"reward": next(scores)})
    run = validating(tmp_path, save_total_limit=2, load_best_model_at_end=True)
    run.train()
    kept = sorted(p.name for p in tmp_path.glob("checkpoint-*"))
    assert kept == ["checkpoint-2", "checkpoint-4"]  # the best, and the last to resume from
    assert run.state.best_metric == 3.0 and run.state.best_global_step == 2
    best = load_file(tmp_path / "checkpoint-2" / "model.safetensors")
    got = weights(run)
    assert all(torch.equal(got[n], best[n]) for n in best)
    assert any(
        not torch.equal(got[n], w) for n, w in load_file(tmp_path / "checkpoint-4" / "model.safetensors").items()
    )
    # Resumed after its end, the result is the best one again.
    again = validating(tmp_path, save_total_limit=2, load_best_model_at_end=True)
    again.train(resume_from_checkpoint=True)
    assert all(torch.equal(weights(again)[n], best[n]) for n in best)


def test_a_resumed_run_has_the_evaluations_of_the_uninterrupted_one(tmp_path: Path) -> None:
    whole = validating(tmp_path / "whole", eval_on_start=True)
    whole.train()
    cut = validating(tmp_path / "cut", eval_on_start=True)
    cut.train()
    resumed = validating(tmp_path / "cut", eval_on_start=True)
    resumed.train(resume_from_checkpoint=str(tmp_path / "cut" / "checkpoint-2"))
    logs = [
        [{k: v for k, v in r.items() if "time" not in k} for r in RunLog(tmp_path / name).read("evaluations.jsonl")]
        for name in ("whole", "cut")
    ]
    assert [r["step"] for r in logs[0]] == [0, 1, 2, 3, 4]
    assert logs[0] == logs[1]


def test_ranks_share_the_tasks_and_agree() -> None:
    spec = AgentSpec.from_data({"reasoning": "rule_based"})
    jobs = [Job(t) for t in HELD_OUT] + [Job(replace(HELD_OUT[0], seed=99))]

    def played(mine: Any) -> list[Any]:
        return [
            replace(
                episode([call(0, [1], [2])], [float(j.task.seed)]),
                status="failed" if j.task.seed == 99 else "completed",
            )
            for j in mine
        ]

    def play(_: AgentSpec, mine: Any) -> list[Any]:
        return [ScoredEpisode(t, RewardSet({"env": 1.0}).score(t)) for t in played(mine)]

    parts: list[Any] = []

    def first(rows: list[Any]) -> list[Any]:
        parts.extend(rows)
        return rows

    one = validate({"": spec}, jobs, play)
    validate({"": spec}, jobs, play, rank=0, ranks=2, gather=first)
    two = validate({"": spec}, jobs, play, rank=1, ranks=2, gather=lambda rows: parts + rows)
    assert one == two
    assert one["reward"] == pytest.approx(sum(t.seed for t in HELD_OUT) / 4)
    assert one["unscorable"] == pytest.approx(1 / 5)
    failed = validate({"": spec}, jobs[-1:], play)
    assert math.isnan(failed["reward"]) and failed["unscorable"] == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"eval_steps": 3, "save_steps": 2}, "eval_steps 3 is no multiple of save_steps 2"),
        ({"validation_tasks": 0}, "validation_tasks is 0"),
        ({"validation_specs": [{"reasoning": "dirct"}]}, "dirct"),
    ],
)
def test_what_cannot_be_validated_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    config = ScaffoldConfig(
        output_dir=str(tmp_path), use_cpu=True, bf16=False, **VALIDATED | {"save_steps": 1} | changes
    )
    with pytest.raises(SpecError, match=message):
        config.check()


def test_rows_of_the_dataset_are_the_tasks_played(tmp_path: Path) -> None:
    run = validating(tmp_path, max_steps=1)
    few = Dataset.from_list(task_rows(HELD_OUT[:1]))
    assert run.evaluate(few)["eval_steps"] == 3.0
