"""From a YAML file and a command line to a run's configuration.

A configuration is a YAML file, or the name of one that comes with the package (`quickstart_cpu`). It may say `extends:
other.yaml` (`agentspec.extends`). Options of the command line win over what files say.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from agentspec.extends import read_extended
from agentspec.registry import SpecError
from trainers.ahead import check_ahead, check_names

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig


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
    words = (word[2:].partition("=")[0].replace("-", "_") for word in rest if word.startswith("--"))
    check_names((word.removeprefix("no_") for word in words if word != "help"), "command line", dashes="--")
    check_ahead(data, rest)
    from trainers.options import ConfigParser

    parser = ConfigParser(source=known.config, description=f"Default configuration: {default}")
    parser.set_defaults_with_config(**data)
    try:
        (config,) = parser.parse_args_into_dataclasses(args=rest)
    except ValueError as error:
        raise SpecError(f"{known.config}, with the command line: {error}") from error
    return config


def read_config(path: str | Path, *, shelf: Path | None = None) -> dict[str, Any]:
    """The fields that a YAML file gives (`agentspec.extends.read_extended`), all of which exist and are read."""
    data = read_extended(path, shelf)
    check_names(data, str(path))
    return data


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise SpecError(f"{message}; a configuration is given as `--config FILE`")
