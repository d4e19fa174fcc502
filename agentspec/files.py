"""Files that survive being interrupted: written whole or not at all, and JSON lines that are appended one by one.

A file of JSON lines holds one record per line. An append that is cut short leaves a last line without its newline and
no other damage: readers pass over it, the next append cuts it off. All records of the project are written by
`json_line`, so that equal records are equal bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from agentspec.registry import SpecError

LONE = "backslashreplace"
"""What becomes of half a surrogate pair, which endpoints answer and no file can hold: its JSON escape."""


def write_atomic(path: str | Path, data: str | bytes) -> None:
    """Write a file so that it is either whole or absent, never half written (temporary file, then rename)."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    blob = data.encode(errors=LONE) if isinstance(data, str) else data
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(blob)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


@contextmanager
def held(path: str | Path, refusal: str, remedy: str, *, again: bool = False) -> Iterator[None]:
    """Inside, nobody else holds the file.

    The operating system holds the lock, so that it is gone when its holder is, however that ended. The file stays, and
    names its holder while there is one.

    Args:
        again: whether its holder may hold it once more, in a block within.

    Raises:
        SpecError: `refusal`, who holds it, and `remedy`.
    """
    from filelock import FileLock, Timeout

    path = Path(path).resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path, timeout=0, is_singleton=again)  # one object per path may be acquired again
    try:
        lock.acquire()
    except Timeout:
        who = path.read_text(encoding="utf-8") or "it is starting or ending"
        raise SpecError(f"{refusal} ({who}); {remedy}") from None
    try:
        path.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        yield
    finally:
        if lock.lock_counter == 1:  # the outermost block
            path.write_text("", encoding="utf-8")
        lock.release()


def jsonable(value: Any) -> Any:
    """`value` as plain JSON data: tuples become lists, numpy scalars numbers, anything else its `str`."""
    if isinstance(value, Mapping):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    return value.item() if hasattr(value, "item") else str(value)


def json_line(record: Mapping[str, Any]) -> str:
    """The record as one line of JSON with its newline; equal records give equal bytes."""
    return json.dumps(jsonable(record), sort_keys=True, ensure_ascii=False) + "\n"


def append_lines(path: str | Path, *records: Mapping[str, Any]) -> None:
    """Append one JSON line per record, on disk when this returns; a line that was cut short is dropped first."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    repair_lines(path)
    with open(path, "a", encoding="utf-8", errors=LONE) as file:
        file.write("".join(map(json_line, records)))
        file.flush()
        os.fsync(file.fileno())


def write_lines(path: str | Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Write a whole file of JSON lines, or nothing."""
    write_atomic(path, "".join(map(json_line, records)))


def repair_lines(path: str | Path) -> None:
    """Cut off a last line without its newline: the only damage that an interrupted append can do."""
    if not Path(path).is_file():
        return
    with open(path, "rb+") as file:
        size = file.seek(0, os.SEEK_END)
        end = _line_start(file, size)
        if end < size:
            file.truncate(end)


def last_line(path: str | Path) -> bytes:
    """The last line that was written to its end; empty if there is none."""
    if not Path(path).is_file():
        return b""
    with open(path, "rb") as file:
        end = _line_start(file, file.seek(0, os.SEEK_END))
        start = _line_start(file, max(0, end - 1))
        file.seek(start)
        return file.read(end - start)


def _line_start(file: BinaryIO, before: int) -> int:
    """Position after the last newline in the first `before` bytes; 0 if there is none."""
    while before:
        start = max(0, before - 65_536)
        file.seek(start)
        newline = file.read(before - start).rfind(b"\n")
        if newline >= 0:
            return start + newline + 1
        before = start
    return 0


def whole_lines(path: str | Path) -> Iterator[tuple[int, bytes]]:
    """Number (from 1) and bytes of every line that was written to its end; blank ones are passed over.

    The file stays as it is; a file that does not exist has no lines.
    """
    if not Path(path).is_file():
        return
    with open(path, "rb") as file:
        for number, line in enumerate(file, 1):
            if line.endswith(b"\n") and line.strip():
                yield number, line


def parse_line(path: str | Path, number: int, line: bytes) -> dict[str, Any]:
    """The record of one line.

    Raises:
        ValueError: naming file and line of what is no JSON object.
    """
    try:
        record = json.loads(line)
    except ValueError as error:
        raise ValueError(f"{path}, line {number}: not JSON ({error}); the file was damaged") from error
    if not isinstance(record, dict):
        raise ValueError(f"{path}, line {number}: expected a JSON object, got {type(record).__name__}")
    return record


def read_lines(path: str | Path) -> list[dict[str, Any]]:
    """The records of all whole lines.

    Raises:
        ValueError: naming file and line of what is no JSON object.
    """
    return [parse_line(path, number, line) for number, line in whole_lines(path)]


def digest(data: bytes | str) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


def file_digest(path: str | Path) -> str:
    """SHA-256 of a file's bytes in hex, read in pieces."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
