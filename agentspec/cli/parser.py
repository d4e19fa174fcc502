"""Arguments of all commands. Nothing heavy is imported to parse them."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from agentspec.cli import audit, compare, evaluate, export, listing, report, run, train, view
from agentspec.cli.errors import PROGRAM, fail


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, as every other error of the input; takes no abbreviated option."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{"allow_abbrev": False, **settings})

    def error(self, message: str) -> NoReturn:
        """Print the message and where help is, and exit with code 2."""
        fail(f"{message}; see `{self.prog} --help`")


def build_parser() -> argparse.ArgumentParser:
    """The parser of ``agentspec``; each command sets ``command`` to the function that runs it."""
    parser = Parser(prog=PROGRAM, description="Embodied LLM agents as typed compositions: run, measure, train.")
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for module in (run, evaluate, report, compare, train, export, audit, listing, view):
        module.add_parser(commands)
    for command in set(commands.choices.values()):
        command.add_argument(
            "--import",
            dest="imports",
            action="append",
            default=[],
            metavar="MODULE|FILE",
            help="bring in modules and environments of your own: a Python module or file (repeatable)",
        )
    return parser


def _version() -> str:
    from agentspec import __version__

    return f"{PROGRAM} {__version__}"
