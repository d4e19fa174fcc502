"""Module state as bytes: compact JSON that restores equal, the order of every mapping included.

Equal data in equal order gives equal bytes. Keys are not sorted: the order of a mapping is part of the state (which
entry is oldest, which was used last), and a module must go on from a snapshot as it would have gone on without one.
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any


def dump_state(data: Any) -> bytes:
    """JSON bytes of `data`; keys of mappings are strings, tuples come back as lists.

    Raises:
        TypeError: a key that is no string (JSON would turn it into one, and the state would restore unequal).
    """
    _require_string_keys(data)
    return json.dumps(data, separators=(",", ":"), ensure_ascii=False).encode()


def load_state(blob: bytes) -> Any:
    """What `dump_state` wrote."""
    return json.loads(blob.decode())


def _require_string_keys(data: Any) -> None:
    if isinstance(data, dict):
        for key, value in data.items():
            if not isinstance(key, str):
                raise TypeError(f"state has the key {key!r} ({type(key).__name__}); keys must be strings: use str(key)")
            _require_string_keys(value)
    elif isinstance(data, list | tuple):
        for value in data:
            _require_string_keys(value)


def write_atomic(path: str | Path, data: str | bytes) -> None:
    """Write a file so that it is either whole or absent, never half written (temporary file, then rename)."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    blob = data.encode() if isinstance(data, str) else data
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
