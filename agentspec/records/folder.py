"""The folder of a run: what its files are called, and which of its checkpoints are whole."""

from __future__ import annotations

from pathlib import Path

from agentspec.carry import FILE as MEMORY
from agentspec.files import file_digest

FORMAT = 4
"""Of manifest, receipts and seal."""
MANIFEST, MANIFESTS = "manifest.json", "manifests"
UPDATES = "updates.jsonl"
METRICS = "metrics.jsonl"
EVALUATIONS = "evaluations.jsonl"
TRAJECTORIES = "trajectories"
SEAL = "seal.json"
SEALED = (MANIFEST, UPDATES, MEMORY, METRICS, EVALUATIONS)
"""The files whose digests the seal holds."""
CHECKPOINT = "checkpoint"
STATE, TRAINER_STATE = "scaffold_state.json", "trainer_state.json"


def checkpoints(folder: str | Path) -> list[Path]:
    """The checkpoints of a run that were written to their end, oldest first.

    A run that was killed while saving leaves a folder without its last file, or (rotation cut short) without its
    trainer state; both are passed over.
    """
    found = {path.name.rpartition("-")[2]: path for path in Path(folder).glob(f"{CHECKPOINT}-*")}
    ordered = [found[number] for number in sorted(filter(str.isdigit, found), key=int)]
    return [path for path in ordered if (path / STATE).is_file() and (path / TRAINER_STATE).is_file()]


def last_complete_checkpoint(folder: str | Path) -> Path | None:
    """The newest of `checkpoints`; `None` if there is none."""
    return next(reversed(checkpoints(folder)), None)


def round_files(folder: Path) -> list[Path]:
    """The trajectory files of all rounds, in `trajectories` and in every other folder of the run that has some."""
    return sorted(p for p in folder.glob("*/[0-9][0-9][0-9][0-9][0-9][0-9]*.jsonl") if p.is_file())


def digest_of(path: Path) -> str:
    """Digest of a file; empty if there is none."""
    return file_digest(path) if path.is_file() else ""
