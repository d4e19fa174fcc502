"""The command line of a run: every field of the configuration is an option, ours first in `--help`."""

from __future__ import annotations

import inspect
import re
from typing import NoReturn

from trl import TrlParser

from agentspec.registry import SpecError
from trainers.ahead import OURS
from trainers.config import ScaffoldConfig
from trainers.fields import USED


def described(config: type) -> dict[str, str]:
    """Field -> what the docstring of its class says under `Args:`."""
    args = (inspect.getdoc(config) or "").partition("Args:\n")[2]
    paragraphs = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", args, re.MULTILINE)
    return {name: " ".join(text.split()).replace("%", "%%") for name, text in paragraphs}


class ConfigParser(TrlParser):
    """TRL's parser; wrong input is one line, no option may be abbreviated, and help begins with what is ours."""

    def __init__(self, *, source: str, description: str) -> None:
        self._source = source
        usage = "%(prog)s [--config FILE] [--FIELD VALUE ...]"
        super().__init__((ScaffoldConfig,), allow_abbrev=False, usage=usage, description=description)
        said = described(ScaffoldConfig)
        for action in self._actions:
            action.help = said.get(action.dest, action.help)

    def error(self, message: str) -> NoReturn:
        raise SpecError(f"{self._source}: {message}; `--help` lists every field")

    def format_help(self) -> str:
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, self._actions, [])
        formatter.add_text(self.description)
        for heading, names in {**OURS, **{f"TRL: {h}": n for h, n in USED.items()}}.items():
            formatter.start_section(heading)
            formatter.add_arguments(a for name in names.split() for a in self._actions if a.dest == name)
            formatter.end_section()
        formatter.add_text("Fields of TRL's that are not listed are not read; docs/training_fields.md says why.")
        return formatter.format_help()
