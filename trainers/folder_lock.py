"""The lock of a run folder: one run at a time writes into it.

The lock is a file that names its holder: machine, process id and the time at which that process began, so that a
process that got the same id later is not taken for it. Where the operating system offers record locks (`fcntl`), it
decides, and a killed run leaves nothing behind that matters. A holder on another machine cannot be asked: it refreshes
the file's time, and is taken for dead when it has not done so for three minutes.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from agentspec.registry import SpecError

try:
    import fcntl
except ImportError:  # no POSIX system: the holder's name decides
    fcntl = None  # type: ignore[assignment]

LOCK = "run.lock"

BEAT_S, STALE_S = 30.0, 180.0
"""How often a holder refreshes its lock, and after how long without that a holder elsewhere is taken for dead."""

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


def holder(folder: str | Path) -> dict[str, Any] | None:
    """Who wrote the folder's lock and is not known to be dead; `None` if nobody."""
    path = Path(folder).resolve() / LOCK
    if path in _in_process:
        return _me()
    try:
        named = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return named if isinstance(named, dict) and _may_live(path, named) else None


def _acquire(path: Path) -> int:
    """The open lock file, with this process named in it."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            locked = _lock(file)
            named = _named(file)
            if locked is False or (named and _may_live(path, named, locked=locked is True)):
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


def _may_live(path: Path, named: dict[str, Any], locked: bool = False) -> bool:
    """Whether the process named in a lock file may still be running.

    Args:
        locked: the operating system gave this process the lock, so that no process of this machine holds it.
    """
    me = _me()
    if named.get("boot") == me["boot"] and me["boot"]:
        if locked:
            return False
        return bool(named.get("started")) and named["started"] == _started(named.get("pid"))
    if named.get("host") == me["host"]:
        return False  # the machine has started anew since
    try:
        return _now(path.parent) - path.stat().st_mtime < STALE_S
    except OSError:
        return False


def _me() -> dict[str, Any]:
    pid = os.getpid()
    return {"host": socket.gethostname(), "boot": _boot(), "pid": pid, "started": _started(pid)}


def _boot() -> str:
    """Names this start of this machine (the same in all of its containers)."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
    return socket.gethostname()


def _started(pid: Any) -> str:
    """When a process of this machine began, in the operating system's own units; empty if there is none."""
    with contextlib.suppress(OSError, IndexError):
        # The name, in brackets, may hold spaces; the start is the 22nd field, the 20th after the name.
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[19]
    if Path("/proc/self/stat").exists() or not isinstance(pid, int):
        return ""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return ""
    except OSError:
        pass
    return "running"


def _now(folder: Path) -> float:
    """The time by the clock that dates the folder's files (that of a file server, say)."""
    probe = folder / f".clock-{os.getpid()}"
    probe.touch()
    try:
        return probe.stat().st_mtime
    finally:
        probe.unlink(missing_ok=True)


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
