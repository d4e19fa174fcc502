"""One run at a time writes into a folder.

A run that begins where an earlier one was moves *everything* of that one together into `earlier/N`: its manifest, logs,
trajectories and checkpoints belong to each other and to no other run.

The operating system holds the folder's lock (`flock`), so that it is gone when its holder is, however that ended. The
file stays, since whoever removed it could not know who had opened it; it names its holder while there is one.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import TextIO

from agentspec.records.folder import (
    CHECKPOINT,
    EVALUATIONS,
    MANIFEST,
    MANIFESTS,
    METRICS,
    SEAL,
    TRAJECTORIES,
    UPDATES,
)
from agentspec.registry import SpecError

try:
    import fcntl
except ImportError:  # no POSIX system
    fcntl = None  # type: ignore[assignment]

LOCK, EARLIER = "run.lock", "earlier"


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
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(number), path.stat()):
                return True
    return False


_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())


@contextlib.contextmanager
def hold(folder: str | Path) -> Iterator[None]:
    """The folder belongs to this run inside; within a block that holds it already, nothing happens.

    Raises:
        SpecError: another run holds it: which, and what to do.
    """
    path = Path(folder).resolve() / LOCK
    if path in _held.get():
        yield
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a+", encoding="utf-8") as file:
        _lock(file)
        _write(file, f"process {os.getpid()} on {socket.gethostname()}")
        token = _held.set(_held.get() | {path})
        try:
            yield
        finally:
            _held.reset(token)
            _write(file, "")


def _lock(file: TextIO) -> None:
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
    except (BlockingIOError, PermissionError):
        file.seek(0)
        folder, who = Path(file.name).parent, file.read() or "it is starting or ending"
        raise SpecError(
            f"{folder} belongs to a run that is under way ({who}); choose another output_dir, or wait for its end"
        ) from None
    except OSError:
        pass
    print(f"note: {file.name} cannot be locked here; see that no second run writes into its folder", file=sys.stderr)


def _write(file: TextIO, text: str) -> None:
    file.truncate(0)
    file.write(text)
    file.flush()
