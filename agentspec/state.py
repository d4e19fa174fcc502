"""Module state as bytes: JSON, compact, with sorted keys, so that equal states are equal bytes."""

from __future__ import annotations

import json
from typing import Any

from agentspec.files import write_atomic

__all__ = ["dump_state", "load_state", "write_atomic"]


def dump_state(data: Any) -> bytes:
    """JSON bytes of ``data``; equal data gives equal bytes."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()


def load_state(blob: bytes) -> Any:
    """What :func:`dump_state` wrote."""
    return json.loads(blob.decode())
