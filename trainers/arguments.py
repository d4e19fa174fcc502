"""From a YAML file and a command line to a run's configuration.

A configuration is a YAML file, or the name of one that comes with the package (`quickstart_cpu`). It may say `extends:
other.yaml`, a path relative to itself or again such a name: it then holds only what differs. The two are joined as a
JSON merge patch (RFC 7386): mappings are merged key by key, `null` takes a key away, and everything else (lists too)
replaces what was there. One rule is ours: a mapping whose `name` is another one replaces the whole mapping, since
parameters belong to the module they are named with. Options of the command line win over both.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from agentspec.actions import suggest
from agentspec.registry import SpecError
from agentspec.spec import load_yaml
from trainers.ahead import KNOWN, check_ahead
from trainers.checks import check_given

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig

EXTENDS = "extends"


def parse_config(argv: Sequence[str] | None = None, *, default: str | Path) -> ScaffoldConfig:
    """The configuration from `--config FILE` and the other options.

    Names and specs are checked before torch and TRL are imported (`trainers.ahead`).

    Args:
        argv: options; default: those of the process.
        default: the YAML file if no `--config` is given; beside it lie those that can be given by name.

    Raises:
        SpecError: malformed YAML, an unknown key or option, a field that nobody reads, a value of the wrong kind.
    """
    first = _Parser(add_help=False, allow_abbrev=False)
    first.add_argument("--config", metavar="FILE", default=str(default))
    known, rest = first.parse_known_args(sys.argv[1:] if argv is None else list(argv))
    data = read_config(known.config, shelf=Path(default).parent)
    check_given(
        (word[2:].partition("=")[0].replace("-", "_") for word in rest if word.startswith("--")), "command line"
    )
    check_ahead(data, rest)
    from trainers.options import ConfigParser

    parser = ConfigParser(source=known.config, description=f"Default configuration: {default}")
    parser.set_defaults_with_config(**data)
    try:
        config, unread = parser.parse_args_into_dataclasses(args=rest, return_remaining_strings=True)
    except ValueError as error:
        raise SpecError(f"{known.config}, with the command line: {error}") from error
    if unread:
        raise SpecError(f"unknown option {unread[0]!r}{suggest(unread[0], parser.options)}")
    return config


def read_config(path: str | Path, *, shelf: Path | None = None) -> dict[str, Any]:
    """The fields that a YAML file gives, with those of the files it extends.

    Args:
        path: a file, or the name of one in `shelf`, with or without `.yaml`.
        shelf: folder of the configurations that can be given by name.

    Raises:
        SpecError: malformed YAML, an unknown key, or a field that nobody reads.
    """
    data = read_layers(path, shelf=shelf)
    for key in data:
        if key not in KNOWN:
            raise SpecError(f"{path}: unknown key {key!r}{suggest(str(key), KNOWN)}")
    check_given(data, str(path))
    return data


def read_layers(path: str | Path, *, shelf: Path | None = None) -> dict[str, Any]:
    """A YAML file over those it extends, whatever its keys mean; arguments and errors as of `read_config`."""
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


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise SpecError(f"{message}; a configuration is given as `--config FILE`")
