"""The folder of a run: what its files are called, which of its checkpoints are whole, who writes into it.

A run that begins where an earlier one was moves *everything* of that one together into `earlier/N`: its manifest, logs,
trajectories and checkpoints belong to each other and to no other run.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from agentspec.carry import FILE as MEMORY
from agentspec.files import file_digest, held

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
LOCK, EARLIER = "run.lock", "earlier"
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


def trained_on(folder: str | Path) -> Iterator[tuple[str, dict[str, Any], int]]:
    """World, its options and number of training tasks of the run that left `folder`, and of those it began with.

    Nothing where the folder is no run's: a shipped adapter, a hub id.
    """
    while folder and (file := Path(folder) / MANIFEST).is_file():
        config = json.loads(file.read_text(encoding="utf-8"))["config"]
        world = config.get("environment") or "deliverybench"
        world = {"name": world} if isinstance(world, str) else world
        yield world["name"], dict(world.get("options") or {}), int(config["train_tasks"])
        folder = config.get("adapter") or ""


def holds_run(folder: str | Path) -> bool:
    """Whether a run has left anything in the folder."""
    folder = Path(folder)
    names = (MANIFEST, MANIFESTS, UPDATES, METRICS, EVALUATIONS, TRAJECTORIES, SEAL)
    return any((folder / name).exists() for name in names) or any(folder.glob(f"{CHECKPOINT}-*"))


def set_aside(folder: str | Path) -> Path | None:
    """Move all that an earlier run left into `folder/earlier/N`, before a new run begins in `folder`.

    Otherwise the records of two runs would mix, and a new run that is killed before its first checkpoint would resume
    from one of the earlier run. If this is cut short, the next call goes on with it, into the same place. Files that
    this process's own output goes to stay where they are.

    Returns:
        where it is now; `None` if there was nothing.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return None
    unfinished = folder / EARLIER / ".moving"
    if not holds_run(folder) and not unfinished.is_dir():
        return None
    unfinished.mkdir(parents=True, exist_ok=True)
    kept = {EARLIER, LOCK}
    # Checkpoints first: what is left behind if this is cut short can then not be resumed from.
    entries = sorted(folder.iterdir(), key=lambda p: (not p.name.startswith(CHECKPOINT), p.name))
    for entry in entries:
        if entry.name not in kept and not _is_output(entry):
            entry.rename(unfinished / entry.name)
    taken = [int(p.name) for p in (folder / EARLIER).iterdir() if p.name.isdigit()]
    place = folder / EARLIER / str(max(taken, default=0) + 1)
    unfinished.rename(place)
    print(f"note: a new run begins in {folder}; the earlier one is in {place}", file=sys.stderr)
    return place


def _is_output(path: Path) -> bool:
    """Whether this process's standard output or error is written to the file."""
    for number in (1, 2):
        with suppress(OSError):
            if os.path.samestat(os.fstat(number), path.stat()):
                return True
    return False


def hold(folder: str | Path) -> AbstractContextManager[None]:
    """The folder belongs to this run inside, or (`SpecError`) to another one (`agentspec.files.held`)."""
    refusal = f"{folder} belongs to a run that is under way"
    return held(Path(folder) / LOCK, refusal, "choose another output_dir, or wait for its end", again=True)
