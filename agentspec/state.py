"""Module state as bytes: compact JSON that restores equal, the order of every mapping included.

Equal data in equal order gives equal bytes. Keys are not sorted: the order of a mapping is part of the state (which
entry is oldest, which was used last), and a module must go on from a snapshot as it would have gone on without one.

A memory of thousands of entries changes few of them between two snapshots. A `Record` (an entry that is replaced and
never changed) keeps its JSON once it is written, so that a snapshot is the joining of texts that are there.
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

from agentspec.files import write_atomic

__all__ = [
    "Json",
    "Record",
    "dump_random",
    "dump_state",
    "joined",
    "keyed",
    "load_random",
    "load_state",
    "write_atomic",
]


_CONTAINERS = (dict, list, tuple)
_ENCODER = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False)


@dataclass(frozen=True)
class Json:
    """A part of a state that is JSON text already; stands in a list for `dump_state` or `joined`, and nowhere else."""

    text: str

    @classmethod
    def of(cls, data: Any) -> Json:
        """`data` as JSON.

        Raises:
            TypeError: see `dump_state`.
        """
        return cls(_text(data))


@dataclass(frozen=True)
class Record:
    """What is replaced and never changed in place, nor what it holds, so that its JSON is written once."""

    def row(self) -> list[Any]:
        """JSON-like fields, in the order of the constructor's arguments."""
        return [getattr(self, field.name) for field in fields(self)]

    @cached_property
    def json(self) -> Json:
        """`row()` as JSON."""
        return Json.of(self.row())


def joined(parts: Iterable[Any]) -> Json:
    """A JSON list of `parts`: `Json`, or data."""
    return Json("[" + ",".join([part.text if isinstance(part, Json) else _text(part) for part in parts]) + "]")


def keyed(records: Mapping[int, Record]) -> Json:
    """A JSON list of pairs, key and record, in order."""
    return Json("[" + ",".join([f"[{key},{record.json.text}]" for key, record in records.items()]) + "]")


def dump_state(data: Any) -> bytes:
    """JSON bytes of `data`; keys of mappings are strings, tuples come back as lists.

    Args:
        data: JSON-like, or a list that holds `Json`.

    Raises:
        TypeError: a key that is no string (JSON would turn it into one, and the state would restore unequal).
    """
    parts = isinstance(data, list) and any(isinstance(part, Json) for part in data)
    return (joined(data).text if parts else _text(data)).encode()


def load_state(blob: bytes) -> Any:
    """What `dump_state` wrote."""
    return json.loads(blob.decode())


def dump_random(rng: random.Random) -> bytes:
    """The state of a generator."""
    return json.dumps(rng.getstate()).encode()


def load_random(rng: random.Random, blob: bytes) -> None:
    """Put a generator back into the state of `dump_random`."""
    version, numbers, gauss = json.loads(blob)
    rng.setstate((version, tuple(numbers), gauss))


def _text(data: Any) -> str:
    _require_string_keys(data)
    return _ENCODER.encode(data)


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
