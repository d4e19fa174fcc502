"""Module state as bytes: compact JSON that restores equal, the order of every mapping included.

Equal data in equal order gives equal bytes. Keys are not sorted: the order of a mapping is part of the state (which
entry is oldest, which was used last), and a module must go on from a snapshot as it would have gone on without one.
"""

from __future__ import annotations

import json
from typing import Any

from agentspec.files import write_atomic

__all__ = ["dump_state", "load_state", "write_atomic"]


_CONTAINERS = (dict, list, tuple)


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
    """Without recursion, and only into what can hold keys: snapshots have tens of thousands of values."""
    containers = [data] if isinstance(data, _CONTAINERS) else []
    while containers:
        value = containers.pop()
        if isinstance(value, dict):
            for key in value:
                if not isinstance(key, str):
                    kind = type(key).__name__
                    raise TypeError(f"state has the key {key!r} ({kind}); keys must be strings: use str(key)")
        inside = value.values() if isinstance(value, dict) else value
        containers += [inner for inner in inside if isinstance(inner, _CONTAINERS)]
