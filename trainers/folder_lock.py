"""The lock of a run folder: one run at a time writes into it.

The operating system holds the lock (`fcntl`), so that it is gone when its holder is, however that ended. Where that
says nothing (no such locks here, or a holder on another machine), the file's time does: a holder refreshes it, and is
taken for dead when it has not done so for three minutes.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from agentspec.registry import SpecError

try:
    import fcntl
except ImportError:  # no POSIX system
    fcntl = None  # type: ignore[assignment]

LOCK = "run.lock"

BEAT_S, STALE_S = 30.0, 180.0
"""How often a holder refreshes its lock, and after how long without that it is taken for dead."""

_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())
_in_process: set[Path] = set()


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
    if path in _in_process:
        raise _refusal(path, _me())
    path.parent.mkdir(parents=True, exist_ok=True)
    file = _acquire(path)
    _in_process.add(path)
    token = _held.set(_held.get() | {path})
    ended = threading.Event()
    threading.Thread(target=_beat, args=(path, ended), name="run-folder-lock", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        _held.reset(token)
        path.unlink(missing_ok=True)
        os.close(file)
        _in_process.discard(path)


def _acquire(path: Path) -> int:
    """The open lock file, with this process named in it."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            locked = _lock(file)
            named = _named(file)
            here = named.get("machine") == _me()["machine"]
            if locked is False or (named and not (locked and here) and _is_fresh(path)):
                raise _refusal(path, named)
            if not path.exists() or not os.path.samestat(os.fstat(file), path.stat()):
                os.close(file)  # its holder left, and took the file away, between these lines
                continue
            os.ftruncate(file, 0)
            os.pwrite(file, json.dumps(_me()).encode(), 0)
            os.fsync(file)
            return file
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(file)
            raise


def _lock(file: int) -> bool | None:
    """Whether the operating system gave the lock; `None` if it has none to give (here, or on this file system)."""
    if fcntl is None:
        return None
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True


def _named(file: int) -> dict[str, Any]:
    try:
        data = json.loads(os.pread(file, 4096, 0) or b"{}")
    except ValueError:
        return {}
    return data if isinstance(data, dict) else {}


def _is_fresh(path: Path) -> bool:
    """Whether somebody refreshed the lock of late."""
    try:
        return time.time() - path.stat().st_mtime < STALE_S
    except OSError:
        return False


def _me() -> dict[str, Any]:
    """This process; `machine` names this start of this machine, the same in all of its containers."""
    host = machine = socket.gethostname()
    with contextlib.suppress(OSError):
        machine = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
    return {"host": host, "machine": machine, "pid": os.getpid()}


def _beat(path: Path, ended: threading.Event) -> None:
    while not ended.wait(BEAT_S):
        with contextlib.suppress(OSError):
            os.utime(path)


def _refusal(path: Path, named: dict[str, Any]) -> SpecError:
    who = f"process {named.get('pid', '?')} on {named.get('host', 'another machine')}"
    return SpecError(
        f"{path.parent} belongs to a run that is under way ({who}); choose another output_dir, or wait for its end. If "
        f"that process is certainly gone, remove {path}"
    )
