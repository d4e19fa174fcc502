"""What a checkpoint needs beyond TRL's, so that a resumed run equals the uninterrupted one.

A run inside a scaffold also has a position within a generation round, rows that were generated and not yet used, and
memories that outlive episodes. They are saved beside TRL's state as JSON (nothing is pickled). The main process's is
the last file of a checkpoint: a folder without it was cut short and is not resumed from.
"""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn
from transformers import TrainerState
from transformers.trainer_utils import PREFIX_CHECKPOINT_DIR, TrainOutput, rotate_checkpoints

from agentspec.files import write_atomic
from agentspec.records.folder import STATE, TRAINER_STATE, hold, set_aside
from agentspec.registry import SpecError
from trainers.micro_batches import ROWS
from trainers.mixin import Base
from trainers.sequences import Row, TokenSequence

FORMAT = 2


@dataclass(frozen=True)
class ScaffoldState:
    """Position and buffers of a run at a checkpoint.

    Args:
    step: micro-batches done (TRL's `_step`).
    round: number of the generation round that filled the buffer.
    buffered: micro-batches of the round, each a list of rows; empty at a round's end.
    memory: state of a memory with `scope: run`.
    """

    step: int
    round: int
    buffered: tuple[tuple[Row, ...], ...] = ()
    memory: bytes | None = None


def save_state(folder: str | Path, state: ScaffoldState, rank: int = 0) -> None:
    """Write this rank's state into a checkpoint folder, atomically."""
    data = {
        "format": FORMAT,
        "step": state.step,
        "round": state.round,
        "buffered": [[_row_to_json(r) for r in rows] for rows in state.buffered],
        "memory": None if state.memory is None else base64.b64encode(state.memory).decode(),
    }
    write_atomic(Path(folder) / _name(rank), json.dumps(data))


def restore_finished(trainer: Any, checkpoint: str | Path) -> TrainOutput | None:
    """The result of a run whose checkpoint is its last one, with the weights loaded; `None` if steps are left.

    The training loop would take one step too many: it looks at the step count only after a step.

    Raises:
        SpecError: the run is over, and its weights are sharded over processes.
    """
    path = Path(checkpoint) / TRAINER_STATE
    if not path.is_file():
        return None
    state = TrainerState.load_from_json(str(path))
    wanted = trainer.args.max_steps if trainer.args.max_steps > 0 else state.max_steps
    if state.global_step < wanted:
        return None
    if trainer.is_deepspeed_enabled or trainer.is_fsdp_enabled:
        raise SpecError(f"{checkpoint} is the last of {wanted} steps; export it, or raise max_steps to train on")
    best = state.best_model_checkpoint if trainer.args.load_best_model_at_end else None
    trainer._load_from_checkpoint(str(best or checkpoint))
    trainer.state = state
    return TrainOutput(state.global_step, 0.0, {})


def load_state(folder: str | Path, rank: int = 0) -> ScaffoldState | None:
    """The state in a checkpoint folder; `None` if it holds none (a checkpoint of stock TRL)."""
    path = Path(folder) / _name(rank)
    if not path.is_file():
        return None
    data = json.loads(path.read_text(encoding="utf-8"))
    if data.get("format") != FORMAT:
        raise ValueError(
            f"{path}: format {data.get('format')!r}, expected {FORMAT}; resume with the version that wrote it"
        )
    return ScaffoldState(
        step=data["step"],
        round=data["round"],
        buffered=tuple(tuple(_row_from_json(r) for r in rows) for rows in data["buffered"]),
        memory=None if data["memory"] is None else base64.b64decode(data["memory"]),
    )


def _name(rank: int) -> str:
    return STATE if rank == 0 else STATE.replace(".json", f".rank{rank}.json")


def _row_to_json(row: Row) -> dict[str, Any]:
    data = asdict(row)
    for name in ("allowed", "paths"):  # JSON has no integer keys
        data["sequence"][name] = list(data["sequence"][name].items())
    return data


def _row_from_json(data: dict[str, Any]) -> Row:
    fields = data["sequence"] | {"paths": dict(data["sequence"]["paths"])}
    fields["allowed"] = {p: tuple(ids) for p, ids in fields["allowed"]}
    advantage = data["advantage"]
    return Row(TokenSequence(**fields), tuple(advantage) if isinstance(advantage, list) else advantage, data["episode"])


class ExactResume(Base):
    """What a trainer saves and loads beyond TRL's; mixed into `trainers.grpo.ScaffoldGRPOTrainer`."""

    def _save_checkpoint(self, model: nn.Module, trial: Any) -> None:
        """As TRL's; the main process's state is written last, and older checkpoints go only after that."""
        run = self._get_output_dir(trial=trial)
        folder = Path(run) / f"{PREFIX_CHECKPOINT_DIR}-{self.state.global_step}"
        main = self.accelerator.is_main_process
        if main:
            (folder / STATE).unlink(missing_ok=True)  # incomplete until it is written (again)
        limit, self.args.save_total_limit = self.args.save_total_limit, None
        try:
            super()._save_checkpoint(model, trial)
        finally:
            self.args.save_total_limit = limit
        unused = (self._buffered_inputs or ()) if self._step % self._steps_per_round else ()
        buffered = tuple(tuple(batch[ROWS]) for batch in unused)
        state = ScaffoldState(self._step, self._round, buffered, self._memory)
        if not main:
            save_state(folder, state, self.accelerator.process_index)
        self.accelerator.wait_for_everyone()
        if main:
            save_state(folder, state)
            best = self.state.best_model_checkpoint
            rotate_checkpoints(run, save_total_limit=limit, best_model_checkpoint=best, use_mtime=True)

    @contextmanager
    def _recorded(self, checkpoint: str) -> Iterator[None]:
        """The run's folder belongs to this run inside, and its manifest is written; the end seals its records.

        What the folder holds beyond the checkpoint is dropped: the resumed run writes it again. A run that does not go
        on from a checkpoint of this folder begins anew: what is there is set aside.
        """
        if not self.accelerator.is_main_process:
            self.accelerator.wait_for_everyone()  # nobody writes before the main process has cleared the folder
            yield
            return
        folder = Path(self.args.output_dir)
        with hold(folder):
            if not checkpoint or Path(checkpoint).resolve().parent != folder.resolve():
                set_aside(folder)
            else:
                step = TrainerState.load_from_json(str(Path(checkpoint) / TRAINER_STATE)).global_step
                state = load_state(checkpoint)
                self.run_log.rewind_to(step, state and state.memory)
            config, spec = self.args.to_dict(), self.args.spec.to_data()
            self.run_log.manifest(config=config, spec=spec, resumed_from=checkpoint)
            self.accelerator.wait_for_everyone()
            yield
            print(f"records of {folder} sealed; head of the chain: {self.run_log.seal()}", file=sys.stderr)

    def _get_train_sampler(self, dataset: Any = None) -> Any:
        self._task_sampler = super()._get_train_sampler(dataset)
        return self._task_sampler

    def _load_optimizer_and_scheduler(self, checkpoint: str | None) -> None:
        super()._load_optimizer_and_scheduler(checkpoint)
        if checkpoint and self._task_sampler.shuffle:
            # The sampler draws one order of tasks per epoch; those of finished epochs were drawn before the stop.
            for _ in range(int((self.state.epoch or 0.0) + 1e-6)):
                torch.randperm(self._task_sampler.num_samples, generator=self._task_sampler.generator)
        state = load_state(checkpoint, self.accelerator.process_index) if checkpoint else None
        if state is None:
            return
        self._step, self._round, self._memory = state.step, state.round, state.memory
        if state.buffered:
            self._buffered_inputs = self._collated([list(rows) for rows in state.buffered])
