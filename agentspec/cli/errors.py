"""Errors of the input as one line and exit code 2; everything else keeps its traceback.

Shared by the command line and the recipes, so that a mistyped name reads the same everywhere.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import NoReturn

import yaml

from agentspec.llm.base import LLMError
from agentspec.registry import SpecError

PROGRAM = "agentspec"
DISTRIBUTION = "agentspec-rl"
"""Its name for pip: `agentspec` is another project there."""

OURS = ("agentspec", "trainers", "rewards", "eval", "recipes")
"""Packages whose `ValueError` is a check of the input; one that numpy or torch raises keeps its traceback."""

EXPECTED = (SpecError, LLMError, yaml.YAMLError, FileNotFoundError, FileExistsError, NotADirectoryError)
EXPECTED_OS = (IsADirectoryError, PermissionError, UnicodeDecodeError)

EXTRAS = {
    "torch": "train",
    "transformers": "train",
    "trl": "train",
    "peft": "train",
    "accelerate": "train",
    "datasets": "train",
    "safetensors": "train",
    "gguf": "train",
    "matplotlib": "train",
    "scipy": "eval",
    "statsmodels": "eval",
    "httpx": "openai",
    "minigrid": "minigrid",
    "openenv": "openenv",
    "uvicorn": "openenv",
    "verifiers": "verifiers",
    "filelock": "eval",
    "tensorboard": "tensorboard",
    "wandb": "wandb",
}
"""Packages that an extra of this one installs."""


def fail(error: BaseException | str) -> NoReturn:
    """Print `agentspec: error: ...` as one line on stderr and exit with code 2."""
    sys.stderr.write(f"{PROGRAM}: error: {one_line(error)}\n")
    raise SystemExit(2) from (error if isinstance(error, BaseException) else None)


@contextmanager
def expected_errors(*more: type[BaseException]) -> Iterator[None]:
    """Turn expected errors inside the block into `fail`.

    Args:
        more: exception types to expect on top of the usual ones (say, those of another library's argument parser).
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, more) or is_expected(error):
            fail(error)
        raise


def is_expected(error: BaseException) -> bool:
    """Whether an error speaks about the input: ours by type, or a `ValueError` that our own code raised."""
    if isinstance(error, ModuleNotFoundError):
        return _package(error) in EXTRAS
    if isinstance(error, (*EXPECTED, *EXPECTED_OS)):
        return True
    return isinstance(error, ValueError) and _raised_by(error.__traceback__).partition(".")[0] in OURS


def one_line(error: BaseException | str) -> str:
    """The message of an error on one line, with what to do."""
    if isinstance(error, ModuleNotFoundError) and _package(error) in EXTRAS:
        package = _package(error)
        text = (
            f"this needs the package {package}, which is not installed; pip install '{DISTRIBUTION}[{EXTRAS[package]}]'"
        )
    elif isinstance(error, UnicodeDecodeError):
        text = f"a file that was given is no UTF-8 text ({error}); check the path"
    elif isinstance(error, OSError) and error.filename is not None:
        text = f"{error.filename}: {error.strerror or type(error).__name__}; check the path"
    elif isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        text = (
            f"malformed YAML in {mark.name} at line {mark.line + 1}, column {mark.column + 1}: {error.problem}; "
            "check indentation and quotes"
        )
    else:
        text = str(error) or type(error).__name__
    return " ".join(text.split())


def require(*packages: str) -> None:
    """Refuse to begin what would end without one of `packages`.

    Raises:
        ModuleNotFoundError: naming the first that is missing; `fail` says what installs it.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)


def _package(error: ModuleNotFoundError) -> str:
    return (error.name or "").partition(".")[0]


def _raised_by(trace: TracebackType | None) -> str:
    """Name of the module whose code raised: the innermost frame."""
    name = ""
    while trace is not None:
        name = str(trace.tb_frame.f_globals.get("__name__", ""))
        trace = trace.tb_next
    return name
