"""The lock of a run folder: one run at a time writes into it.

The operating system holds the lock (`flock`), so that it is gone when its holder is, however that ended. The file stays
where it is, since whoever removed it could not know who had opened it; it names its holder while there is one.
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

from agentspec.registry import SpecError

try:
    import fcntl
except ImportError:  # no POSIX system
    fcntl = None  # type: ignore[assignment]

LOCK = "run.lock"

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
