"""What a checkpoint needs beyond TRL's, so that a resumed run equals the uninterrupted one.

TRL and transformers save weights, optimiser, scheduler, their random states and the position in the data. A run inside
a scaffold also has: the position within a generation round, rows that were generated and not yet used, and memories
that outlive episodes. They are saved beside the rest as JSON (rows are token lists: nothing is pickled).

The main process's state is the last file of a checkpoint: a folder without it was cut short and is not resumed from.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from transformers import TrainerState
from transformers.trainer_utils import PREFIX_CHECKPOINT_DIR, TrainOutput

from agentspec.registry import SpecError
from agentspec.state import write_atomic
from trainers.batches import Row
from trainers.sequences import TokenSequence

FILE = "scaffold_state.json"
TRAINER_STATE = "trainer_state.json"
FORMAT = 1


@dataclass(frozen=True)
class ScaffoldState:
    """Position and buffers of a run at a checkpoint.

    Args:
        step: micro-batches done (TRL's ``_step``).
        round: number of the generation round that filled the buffer.
        buffered: micro-batches of the round, each a list of rows; empty at a round's end.
        memory: state of a memory with ``scope: run``.
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
        "buffered": [[_row_to_json(r) for r in hand] for hand in state.buffered],
        "memory": None if state.memory is None else base64.b64encode(state.memory).decode(),
    }
    write_atomic(Path(folder) / _name(rank), json.dumps(data))


def unmark(folder: str | Path) -> None:
    """Declare a checkpoint incomplete: it is about to be written (again)."""
    (Path(folder) / FILE).unlink(missing_ok=True)


def last_complete_checkpoint(folder: str | Path) -> Path | None:
    """The newest checkpoint of a run that was written to its end; ``None`` if there is none.

    A run that was killed while saving leaves a folder without its last file, or (rotation cut short) without its
    trainer state; both are passed over.
    """
    found = [
        (int(number), path)
        for path in Path(folder).glob(f"{PREFIX_CHECKPOINT_DIR}-*")
        if (number := path.name.rpartition("-")[2]).isdigit()
    ]
    complete = [(n, p) for n, p in found if (p / FILE).is_file() and (p / TRAINER_STATE).is_file()]
    return max(complete)[1] if complete else None


def restore_finished(trainer: Any, checkpoint: str | Path) -> TrainOutput | None:
    """The result of a run whose checkpoint is its last one, with the weights loaded; ``None`` if steps are left.

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
    trainer._load_from_checkpoint(str(checkpoint))
    trainer.state = state
    return TrainOutput(state.global_step, 0.0, {})


def load_state(folder: str | Path, rank: int = 0) -> ScaffoldState | None:
    """The state in a checkpoint folder; ``None`` if it holds none (a checkpoint of stock TRL).

    Raises:
        ValueError: a file of another format.
    """
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
        buffered=tuple(tuple(_row_from_json(r) for r in hand) for hand in data["buffered"]),
        memory=None if data["memory"] is None else base64.b64decode(data["memory"]),
    )


def _name(rank: int) -> str:
    return FILE if rank == 0 else FILE.replace(".json", f".rank{rank}.json")


def _row_to_json(row: Row) -> dict[str, Any]:
    data = asdict(row)
    data["sequence"]["allowed"] = [[p, list(ids)] for p, ids in row.sequence.allowed.items()]
    return data


def _row_from_json(data: dict[str, Any]) -> Row:
    fields = dict(data["sequence"])
    fields["allowed"] = {p: tuple(ids) for p, ids in fields["allowed"]}
    advantage = data["advantage"]
    return Row(TokenSequence(**fields), tuple(advantage) if isinstance(advantage, list) else advantage, data["episode"])


def rewind_logs(log: Any, step: int) -> None:
    """Drop what the logs hold beyond checkpoint ``step``: the resumed run writes it again."""
    log.rewind("metrics.jsonl", "step", step)
    log.rewind("updates.jsonl", "round", step - 1)


def rows_of(batches: Sequence[dict[str, Any]] | None, key: str) -> tuple[tuple[Row, ...], ...]:
    """The rows of buffered micro-batches."""
    return tuple(tuple(batch[key]) for batch in batches or ())
