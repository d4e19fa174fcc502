"""YAML files that say `extends: other.yaml`: they hold only what differs from another file.

The path is relative to the file that says it, or the name of a file on a shelf. The two are joined as a JSON merge
patch (RFC 7386): mappings are merged key by key, `null` takes a key away, and everything else (lists too) replaces what
was there. One rule is ours: a mapping whose `name` is another one replaces the whole mapping, since parameters belong
to the module they are named with.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agentspec.actions import suggest
from agentspec.registry import SpecError
from agentspec.spec import load_yaml

EXTENDS = "extends"


def read_extended(path: str | Path, shelf: Path | None = None) -> dict[str, Any]:
    """The mapping that a YAML file gives, with those of the files it extends.

    Args:
        path: a file, or the name of one in `shelf`, with or without `.yaml`.
        shelf: folder of the files that can be given by name.

    Raises:
        SpecError: no such file, malformed YAML, no mapping, or a file that extends itself.
    """
    return _read(_found(Path(path), shelf), (), shelf)


def _found(path: Path, shelf: Path | None) -> Path:
    """`path`, or the file of that name on the shelf; a name that is nowhere is an error that lists those there are."""
    if shelf is None or path.exists() or path.parent != Path():
        return path
    for file in (shelf / path.name, shelf / f"{path.name}.yaml"):
        if file.is_file():
            return file
    names = [file.stem for file in shelf.glob("*.yaml")]
    raise SpecError(f"no such YAML file: {path}; give a path to an existing file, or a name{suggest(path.stem, names)}")


def _read(path: Path, above: tuple[Path, ...], shelf: Path | None) -> dict[str, Any]:
    if path.resolve() in above:
        chain = " extends ".join(str(p) for p in (*above, path.resolve()))
        raise SpecError(f"{path}: a configuration cannot extend itself ({chain}); take one `{EXTENDS}` out")
    data = load_yaml(path)
    if not isinstance(data, dict):
        raise SpecError(f"{path}: expected a mapping of fields to values, got {type(data).__name__}")
    parent = data.pop(EXTENDS, None)
    if parent is None:
        return data
    if not isinstance(parent, str):
        raise SpecError(
            f"{path}: `{EXTENDS}` is {parent!r}; expected the path of one YAML file, relative to this one, or a name"
        )
    beside = path.parent / parent
    source = beside if beside.is_file() else _found(Path(parent), shelf)
    return merged(_read(source if source.is_file() else beside, (*above, path.resolve()), shelf), data)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with `changes` (see the module's text); neither is altered.

    >>> merged({"a": {"x": 1, "y": 2}, "b": [1]}, {"a": {"y": None, "z": 3}, "b": [2]})
    {'a': {'x': 1, 'z': 3}, 'b': [2]}
    """
    result = dict(base)
    for key, value in changes.items():
        under = result.get(key)
        if value is None:
            result.pop(key, None)
        elif isinstance(value, Mapping):
            below: Mapping[str, Any] = under if isinstance(under, Mapping) else {}
            another = value.get("name", below.get("name")) != below.get("name")
            result[key] = merged({} if another else below, value)
        else:
            result[key] = value
    return result
