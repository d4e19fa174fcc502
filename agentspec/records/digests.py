"""Digests of a record by field: what is stated of it elsewhere, so that an edit can be named.

A digest of a whole file says that something was edited; these say in which field of which record: `config.seed`,
`calls.completions.logprobs`. No field is listed here, so none can be forgotten.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from agentspec.files import digest


def field_digests(record: Mapping[str, Any]) -> dict[str, str]:
    """Path of a field -> 12 hex digits over all its values in the record.

    A mapping at the top has a path for each key; records in a list share theirs, with their places.
    """
    values: dict[str, list[Any]] = defaultdict(list)

    def add(data: Mapping[str, Any], above: str, place: tuple[int, ...]) -> None:
        for name in sorted(data):
            value, path = data[name], above + name
            if value and isinstance(value, list) and all(isinstance(v, dict) for v in value):
                values[path].append([place, len(value)])
                for i, inner in enumerate(value):
                    add(inner, f"{path}.", (*place, i))
            elif value and isinstance(value, Mapping) and not above:
                for key in sorted(value):
                    values[f"{path}.{key}"].append([place, value[key]])
            else:
                values[path].append([place, value])

    add(record, "", ())
    return {path: short_digest(found) for path, found in sorted(values.items())}


def differing(recorded: Any, found: Mapping[str, str]) -> list[str]:
    """Names whose digests differ, or that only one of the two has."""
    known = recorded if isinstance(recorded, Mapping) else {}
    return sorted(name for name in {*known, *found} if known.get(name) != found.get(name))


def short_digest(value: Any) -> str:
    """12 hex digits over JSON data."""
    return digest(json.dumps(value, sort_keys=True, separators=(",", ":")))[:12]
