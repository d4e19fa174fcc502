"""Invariant 6: a run stopped at any checkpoint and resumed equals the uninterrupted one, bit for bit on a CPU."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from datasets import Dataset

from agentspec.files import file_digest
from agentspec.records.folder import LOCK, checkpoints, last_complete_checkpoint
from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from agentspec.types import Task
from tests.tiny import tiny_model, tiny_tokenizer
from tests.toy_env import TOY
from tests.trainers.builders import CPU_RUN, call, episode
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.resume import ScaffoldState, load_state, save_state
from trainers.rollouts import task_rows
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
            # The chain holds digests of records with times in them.
            [{k: v for k, v in r.items() if "time" not in k and k != "chain"} for r in RunLog(folder).read(name)]
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


def _files(folder: Path) -> dict[str, bytes]:
    """Every file below a run's folder but its lock."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != LOCK and "earlier" not in p.relative_to(folder).parts
    }


def test_a_new_run_moves_everything_of_an_old_one_together(tmp_path: Path) -> None:
    """Records of two runs never mix: each is audited on its own, and both are whole."""
    trainer(tmp_path, max_steps=2).train()
    old = _files(tmp_path)
    trainer(tmp_path, max_steps=1).train(resume_from_checkpoint=None)
    assert [r["round"] for r in RunLog(tmp_path).read("updates.jsonl")] == [0]
    assert [r["step"] for r in RunLog(tmp_path).read("metrics.jsonl")] == [1]
    assert [p.name for p in (tmp_path / "trajectories").iterdir()] == ["000000.jsonl"]
    assert _files(tmp_path / "earlier" / "1") == old
    assert {"manifest.json", "updates.jsonl", "metrics.jsonl", "trajectories/000001.jsonl"} <= old.keys()
    for folder, updates in ((tmp_path, 1), (tmp_path / "earlier" / "1", 2)):
        assert [(r.violations, r.notes) for r in audit(folder)] == [([], [])] * updates


def test_a_second_run_into_a_live_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It changes nothing of the run that is under way, which ends as if nobody had come."""
    first, second = trainer(tmp_path, max_steps=1), trainer(tmp_path, max_steps=1, learning_rate=1.0)
    play, refusals, seen = first._play, [], []

    def intruded(*args: Any, **kwargs: Any) -> Any:
        def intrude() -> None:
            try:
                second.train()
            except SpecError as error:
                refusals.append(str(error))

        before = _files(tmp_path)
        thread = threading.Thread(target=intrude)
        thread.start()
        thread.join()
        seen.append(_files(tmp_path) == before)
        return play(*args, **kwargs)

    monkeypatch.setattr(first, "_play", intruded)
    first.train()
    assert len(refusals) == 1 and "under way" in refusals[0] and "another output_dir" in refusals[0]
    assert seen == [True] and not (tmp_path / "earlier").exists()
    assert [(r.round, r.violations, r.notes) for r in audit(tmp_path)] == [(0, [], [])]
    second.train()  # the folder is free again
    assert [(r.round, r.violations) for r in audit(tmp_path)] == [(0, [])]


def test_a_second_resume_into_a_live_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two that take up the same interrupted run: the second would drop what the first has written since."""
    first = trainer(tmp_path)
    first.add_callback(_stop_after(2))
    first.train()
    one, two = trainer(tmp_path), trainer(tmp_path)
    play, refusals, seen = one._play, [], []

    def intruded(*args: Any, **kwargs: Any) -> Any:
        before = _files(tmp_path)
        thread = threading.Thread(target=intrude)
        thread.start()
        thread.join()
        seen.append(_files(tmp_path) == before)
        return play(*args, **kwargs)

    def intrude() -> None:
        try:
            two.train(resume_from_checkpoint=True)
        except SpecError as error:
            refusals.append(str(error))

    monkeypatch.setattr(one, "_play", intruded)
    one.train(resume_from_checkpoint=True)
    assert seen == [True, True] and len(refusals) == 2 and all("under way" in r for r in refusals)
    assert [(r.round, r.violations, r.notes) for r in audit(tmp_path)] == [(n, [], []) for n in range(4)]


def test_a_resumed_run_keeps_its_earlier_manifest(tmp_path: Path) -> None:
    """Receipts from before name it; what the resumed run writes names the new one, which names the old."""
    first = trainer(tmp_path)
    first.add_callback(_stop_after(2))
    first.train()
    trainer(tmp_path).train(resume_from_checkpoint=True)
    records = RunLog(tmp_path).read("updates.jsonl")
    old, new = file_digest(tmp_path / "manifests" / "000000.json"), file_digest(tmp_path / "manifest.json")
    assert [r["chain"]["manifest"] for r in records] == [old, old, new, new]
    assert json.loads((tmp_path / "manifest.json").read_text())["previous"] == old
    assert [(r.violations, r.notes) for r in audit(tmp_path)] == [([], [])] * 4


def test_episodes_that_a_resumed_run_plays_again_leave_no_trace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed between a round's episodes and its receipt, then resumed for fewer rounds: nothing is unaccounted for."""
    killed = trainer(tmp_path)
    monkeypatch.setattr(killed, "_log_update", _killed_at(killed, killed._log_update, 2))
    with pytest.raises(KeyboardInterrupt):
        killed.train()
    assert (tmp_path / "trajectories" / "000002.jsonl").is_file()
    (cut,) = [r for r in audit(tmp_path) if r.notes]
    assert "under way after update 1" in cut.notes[0] and cut.violations == []  # a round under way
    trainer(tmp_path, max_steps=2).train(resume_from_checkpoint=True)
    assert sorted(p.name for p in (tmp_path / "trajectories").iterdir()) == ["000000.jsonl", "000001.jsonl"]
    assert [(r.violations, r.notes) for r in audit(tmp_path)] == [([], [])] * 2


def _killed_at(run: ScaffoldGRPOTrainer, log: Any, step: int) -> Any:
    def killed(rows: Any) -> None:
        if run.state.global_step == step:
            raise KeyboardInterrupt
        log(rows)

    return killed


def test_a_new_run_that_is_killed_has_nothing_of_an_old_one_to_resume_from(
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
    assert [p.name for p in checkpoints(tmp_path)] == ["checkpoint-1"]
    assert sorted(p.name for p in (tmp_path / "earlier").iterdir()) == ["1", "2"]  # the old run, and the killed one
    assert [p.name for p in checkpoints(aside)] == ["checkpoint-1", "checkpoint-2"]


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


def test_after_a_round_the_backend_holds_nothing(tmp_path: Path) -> None:
    """The update needs the memory, and what was read with the old weights is of no use after it."""
    run = trainer(tmp_path)
    held: list[int] = []
    compute = run._compute_loss

    def noting(*args: Any, **kwargs: Any) -> Any:
        held.append(len(run.llm._engine.cache))
        return compute(*args, **kwargs)

    run._compute_loss = noting
    run.train()
    assert held and not any(held)
