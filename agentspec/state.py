"""Module state as bytes: JSON, compact, with sorted keys, so that equal states are equal bytes."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any


def dump_state(data: Any) -> bytes:
    """JSON bytes of ``data``; equal data gives equal bytes."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()


def load_state(blob: bytes) -> Any:
    """What :func:`dump_state` wrote."""
    return json.loads(blob.decode())


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
