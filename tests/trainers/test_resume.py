"""Invariant 6: a run stopped at any checkpoint and resumed equals the uninterrupted one, bit for bit on a CPU."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from datasets import Dataset

from agentspec.types import Task
from tests.tiny import tiny_model, tiny_tokenizer
from tests.toy_env import TOY
from tests.trainers.builders import CPU_RUN, call, episode
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.resume import ScaffoldState, checkpoints, last_complete_checkpoint, load_state, save_state, set_aside
from trainers.rollouts import task_rows
from trainers.runlog import RunLog
from trainers.sequences import Row, build_sequences


def trainer(folder: Path, *, held_out: Sequence[Task] = (), **changes: Any) -> ScaffoldGRPOTrainer:
    settings: dict[str, Any] = {
        "output_dir": str(folder),
        "agent": {"reasoning": "direct", "sampling": {"max_tokens": 8}},
        "per_device_train_batch_size": 2,
        "gradient_accumulation_steps": 2,
        "num_generations": 2,
        "max_steps": 4,
        "save_steps": 1,
        **CPU_RUN,
        **changes,
    }
    tokenizer = tiny_tokenizer()
    tasks = [Task(TOY, seed, {"steps": 3, "menu": True}) for seed in range(6)]
    return ScaffoldGRPOTrainer(
        tiny_model(tokenizer),
        ScaffoldConfig(**settings),
        train_dataset=Dataset.from_list(task_rows(tasks)),
        eval_dataset=Dataset.from_list(task_rows(held_out)) if held_out else None,
        processing_class=tokenizer,
    )


def weights(run: ScaffoldGRPOTrainer) -> dict[str, torch.Tensor]:
    return {n: p.detach().clone() for n, p in run.model.named_parameters()}


# Two iterations per round and rounds of two optimiser steps put checkpoints in the middle of a round.
@pytest.mark.parametrize("changes", [{}, {"num_iterations": 2}, {"steps_per_generation": 4, "max_steps": 5}])
@pytest.mark.parametrize("stop", [1, 3])
def test_a_resumed_run_equals_the_uninterrupted_one(tmp_path: Path, changes: dict[str, Any], stop: int) -> None:
    whole = trainer(tmp_path / "whole", **changes)
    whole.train()
    before = tmp_path / "cut"
    steps = changes.get("max_steps", 4)
    # The schedule must know the whole length, so the first part is stopped from outside.
    first = trainer(before, **changes)
    first.add_callback(_stop_after(stop))
    first.train()
    resumed = trainer(before, **changes)
    resumed.train(resume_from_checkpoint=str(before / f"checkpoint-{stop}"))
    assert resumed.state.global_step == steps
    expected, got = weights(whole), weights(resumed)
    assert all(torch.equal(expected[n], got[n]) for n in expected)
    for name in ("updates.jsonl", "metrics.jsonl"):
        got_log, want_log = (
            [{k: v for k, v in record.items() if "time" not in k} for record in RunLog(folder).read(name)]
            for folder in (before, tmp_path / "whole")
        )
        assert got_log == want_log and got_log, name
    receipts = list(audit(before))
    assert receipts and not [v for r in receipts for v in r.violations]


def _stop_after(step: int) -> Any:
    from transformers import TrainerCallback

    class Stop(TrainerCallback):
        def on_step_end(self, args: Any, state: Any, control: Any, **_: Any) -> Any:
            control.should_training_stop = state.global_step >= step
            return control

    return Stop()


def test_state_round_trip(tmp_path: Path) -> None:
    sequence = build_sequences(episode([call(0, [1, 2], [5, 7], allowed=((5, 6), (7,)))]))[0]
    rows = (Row(sequence, 0.25, 0), Row(sequence, (0.0, 0.0, 0.5, 0.0), 1))
    state = ScaffoldState(3, 2, (rows, rows[:1]), b"\x00memory")
    save_state(tmp_path, state)
    assert load_state(tmp_path) == state
    assert load_state(tmp_path / "elsewhere") is None
    (tmp_path / "scaffold_state.json").write_text('{"format": 99}')
    with pytest.raises(ValueError, match="format 99, expected 2"):
        load_state(tmp_path)


def test_a_finished_run_takes_no_step_more(tmp_path: Path) -> None:
    """Killed after its last checkpoint, before the final weights were written: resuming gives exactly these."""
    whole = trainer(tmp_path, max_steps=2)
    whole.train()
    again = trainer(tmp_path, max_steps=2)
    again.train(resume_from_checkpoint=True)  # the last complete checkpoint
    assert again.state.global_step == 2
    expected, got = weights(whole), weights(again)
    assert all(torch.equal(expected[n], got[n]) for n in expected)
    assert [r["round"] for r in RunLog(tmp_path).read("updates.jsonl")] == [0, 1]
    longer = trainer(tmp_path, max_steps=3)
    longer.train(resume_from_checkpoint=True)
    assert [r["round"] for r in RunLog(tmp_path).read("updates.jsonl")] == [0, 1, 2]


def test_a_new_run_in_the_folder_of_an_old_one_starts_new_logs(tmp_path: Path) -> None:
    trainer(tmp_path, max_steps=2).train()
    trainer(tmp_path, max_steps=1).train(resume_from_checkpoint=None)
    assert [r["round"] for r in RunLog(tmp_path).read("updates.jsonl")] == [0]
    assert [r["step"] for r in RunLog(tmp_path).read("metrics.jsonl")] == [1]


def test_a_new_run_sets_the_checkpoints_of_an_old_one_aside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed before its first checkpoint, it has none to resume from, and nothing of the old run is lost."""
    trainer(tmp_path, max_steps=2).train()
    killed = trainer(tmp_path, max_steps=2)
    monkeypatch.setattr(killed, "_play", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        killed.train()
    assert last_complete_checkpoint(tmp_path) is None
    aside = tmp_path / "earlier" / "1"
    assert last_complete_checkpoint(aside) == aside / "checkpoint-2"
    assert str(aside) in capsys.readouterr().err
    # Resuming with nothing to resume from begins anew; a third run does not mix with the first.
    again = trainer(tmp_path, max_steps=1)
    again.train(resume_from_checkpoint=True)
    assert set_aside(tmp_path) == tmp_path / "earlier" / "2"
    assert [p.name for p in checkpoints(tmp_path / "earlier" / "2")] == ["checkpoint-1"]
    assert set_aside(tmp_path) is None


def test_a_checkpoint_is_complete_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever interrupts a save, the checkpoint before is still there and is the one to resume from."""
    from trainers import resume as module

    run = trainer(tmp_path, save_total_limit=1)
    saved = module.save_state

    def interrupted(folder: Path, *args: Any) -> None:
        if folder.name == "checkpoint-3":
            raise KeyboardInterrupt
        saved(folder, *args)

    monkeypatch.setattr(module, "save_state", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run.train()
    assert sorted(p.name for p in tmp_path.glob("checkpoint-*")) == ["checkpoint-2", "checkpoint-3"]
    assert last_complete_checkpoint(tmp_path) == tmp_path / "checkpoint-2"
