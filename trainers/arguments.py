"""From a YAML file and a command line to a run's configuration.

A YAML file may say `extends: other.yaml`, a path relative to itself: it then holds only what differs. The two are
joined as a JSON merge patch (RFC 7386): mappings are merged key by key, `null` takes a key away, and everything else
(lists too) replaces what was there. One rule is ours: a mapping whose `name` is another one replaces the whole mapping,
since parameters belong to the module they are named with. Options of the command line win over both.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from trl import TrlParser

from agentspec.actions import suggest
from agentspec.registry import SpecError
from agentspec.spec import load_yaml
from trainers.checks import check_given
from trainers.config import ScaffoldConfig
from trainers.fields import USED

EXTENDS = "extends"

OURS = {
    "model": "model adapter actor_adapter actor_temperature lora_r lora_alpha lora_targets lora_layers",
    "agent and world": "agent environment train_tasks memory_carry start_memory retries env_timeout_s "
    "rollout_concurrency batching",
    "credit and loss": "train_calls train_credits rewards estimator reference gamma gigpo_weight skip_zero_variance "
    "write_credit write_calls write_rerolls write_points "
    "normalize overlong overlong_ends mask_truncated packing tokens_per_forward",
    "evaluation": "eval_tasks eval_specs eval_sampling validation_tasks validation_specs",
    "this run": "resume plots",
}
"""Headings of `--help` and the fields under them; TRL's own (`trainers.fields.USED`) follow."""


def parse_config(argv: Sequence[str] | None = None, *, default: str | Path) -> ScaffoldConfig:
    """The configuration from `--config FILE` and the other options.

    Args:
        argv: options; default: those of the process.
        default: the YAML file if no `--config` is given.

    Raises:
        SpecError: malformed YAML, an unknown key or option, a field that nobody reads, a value of the wrong kind.
    """
    first = _Parser(add_help=False, allow_abbrev=False)
    first.add_argument("--config", metavar="FILE", default=str(default))
    known, rest = first.parse_known_args(sys.argv[1:] if argv is None else list(argv))
    data = read_config(known.config)
    parser = _ConfigParser(ScaffoldConfig, source=known.config, description=f"Default configuration: {default}")
    parser.set_defaults_with_config(**data)
    check_given(
        (word[2:].partition("=")[0].replace("-", "_") for word in rest if word.startswith("--")), "command line"
    )
    try:
        config, unread = parser.parse_args_into_dataclasses(args=rest, return_remaining_strings=True)
    except ValueError as error:
        raise SpecError(f"{known.config}, with the command line: {error}") from error
    if unread:
        options = [o for action in parser._actions for o in action.option_strings if "-" not in o[2:]]
        raise SpecError(f"unknown option {unread[0]!r}{suggest(unread[0], options)}")
    return config


def read_config(path: str | Path) -> dict[str, Any]:
    """The fields that a YAML file gives, with those of the files it extends.

    Raises:
        SpecError: malformed YAML, an unknown key, or a field that nobody reads.
    """
    data = _read(Path(path), ())
    fields = ScaffoldConfig.__dataclass_fields__
    for key in data:
        if key not in fields:
            raise SpecError(f"{path}: unknown key {key!r}{suggest(str(key), fields)}")
    check_given(data, str(path))
    return data


def _read(path: Path, above: tuple[Path, ...]) -> dict[str, Any]:
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
        raise SpecError(f"{path}: `{EXTENDS}` is {parent!r}; expected the path of one YAML file, relative to this one")
    return merged(_read(path.parent / parent, (*above, path.resolve())), data)


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


def described(config: type) -> dict[str, str]:
    """Field -> what the docstring of its class says under `Args:`."""
    args = (inspect.getdoc(config) or "").partition("Args:\n")[2]
    paragraphs = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", args, re.MULTILINE)
    return {name: " ".join(text.split()).replace("%", "%%") for name, text in paragraphs}


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise SpecError(f"{message}; a configuration is given as `--config FILE`")


class _ConfigParser(TrlParser):
    """TRL's parser; wrong input is one line, no option may be abbreviated, and help begins with what is ours."""

    def __init__(self, config: type, *, source: str, description: str) -> None:
        self._source = source
        usage = "%(prog)s [--config FILE] [--FIELD VALUE ...]"
        super().__init__((config,), allow_abbrev=False, usage=usage, description=description)
        said = described(config)
        for action in self._actions:
            action.help = said.get(action.dest, action.help)

    def error(self, message: str) -> NoReturn:
        raise SpecError(f"{self._source}: {message}; `--help` lists every field")

    def format_help(self) -> str:
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, [])
        formatter.add_text(self.description)
        listed = " ".join((*OURS.values(), *USED.values())).split()
        more = [n for n in ScaffoldConfig.__annotations__ if n not in listed]  # of ours, without a heading
        ours = {**OURS, "this run": " ".join((OURS["this run"], *more))}
        for heading, names in {**ours, **{f"TRL: {h}": n for h, n in USED.items()}}.items():
            formatter.start_section(heading)
            formatter.add_arguments(a for name in names.split() for a in self._actions if a.dest == name)
            formatter.end_section()
        formatter.add_text("Fields of TRL's that are not listed are not read; docs/training_fields.md says why.")
        return formatter.format_help()
