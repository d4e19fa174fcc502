"""What several commands take: an environment with options, specs, seeds, a model."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.tasks import parse_seeds

if TYPE_CHECKING:
    from agentspec.policies import Policy

LABEL_CHARACTERS = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-+.() ")


def at_least(lowest: int) -> Callable[[str], int]:
    """A type of argument: whole numbers from `lowest` on."""

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"expected a whole number, got {text!r}") from None
        if number < lowest:
            raise argparse.ArgumentTypeError(f"expected at least {lowest}, got {number}")
        return number

    return read


def above(limit: float) -> Callable[[str], float]:
    """A type of argument: finite numbers above `limit`."""

    def read(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"expected a number, got {text!r}") from None
        if not limit < number < math.inf:
            raise argparse.ArgumentTypeError(f"expected a number above {limit:g}, got {text}")
        return number

    return read


def add_environment(parser: argparse.ArgumentParser) -> None:
    """``--env`` and the options of the environment."""
    group = parser.add_argument_group("environment")
    group.add_argument("--env", default="deliverybench", help="registered name or gymnasium id (default: %(default)s)")
    group.add_argument("--map", metavar="DIR", help="folder of a city map (default: a generated city)")
    group.add_argument("--shift-hours", type=above(0), metavar="H", help="length of the shift, in simulated hours")
    group.add_argument("--observation", metavar="NAME", help="compact, or another of the world's texts")
    group.add_argument("--action-mode", choices=("native", "menu"), help="write action calls, or choose from a menu")
    group.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="any other option of the environment; the value is YAML; may be repeated",
    )
    group.add_argument("--max-steps", type=at_least(1), metavar="N", help="most steps of an episode")
    group.add_argument(
        "--timeout",
        type=above(0),
        default=60.0,
        metavar="S",
        help="seconds per environment call (default: 60)",
    )


def environment_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options for ``gymnasium.make``: those that were given, and no others."""
    named = ("map", "shift_hours", "observation", "action_mode")
    given = {name: getattr(arguments, name) for name in named if getattr(arguments, name) is not None}
    return given | key_values(arguments.option, "--option")


def add_model(parser: argparse.ArgumentParser) -> None:
    """Settings of the backend."""
    group = parser.add_argument_group("model")
    group.add_argument(
        "--llm",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="setting of the model backend, e.g. backend=openai, base_url=..., dtype=bfloat16; may be repeated",
    )
    group.add_argument("--prices", metavar="FILE", help="YAML: {model: {input: $/M tokens, output: ..., cached: ...}}")


def load_prices(path: str | None) -> Any:
    """The price table of ``--prices`` (all models free without one)."""
    from agentspec.llm.pricing import Prices

    return Prices.from_yaml(path) if path else Prices()


def key_values(items: Sequence[str], what: str) -> dict[str, Any]:
    """``["a=1", "b=[x]"]`` as ``{"a": 1, "b": ["x"]}``; values are YAML.

    Raises:
        SpecError: an item without ``=`` or with a malformed value.
    """
    found = {}
    for item in items:
        key, equals, text = item.partition("=")
        if not equals or not key.strip():
            raise SpecError(f"{what} {item!r}: expected KEY=VALUE")
        try:
            found[key.strip().replace("-", "_")] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            problem = getattr(error, "problem", None) or "malformed"
            raise SpecError(f"{what} {item!r}: the value is not YAML ({problem}); quote it") from error
    return found


def labelled_spec(text: str) -> tuple[str, AgentSpec]:
    """``FILE``, ``LABEL=FILE``, ``LABEL=YAML`` or inline YAML, as (label, spec).

    Without a label, a file's is its name and inline YAML's is the spec's own (``react+base``).
    """
    label, equals, rest = text.partition("=")
    if Path(text).is_file() or not equals or not set(label) <= LABEL_CHARACTERS:
        label, rest = "", text
    spec = AgentSpec.from_yaml(rest)
    if not label:
        label = Path(rest).stem if Path(rest).is_file() else spec.label
    return label, spec


def parse_policy(text: str, arguments: argparse.Namespace) -> Policy:
    """A policy, with the settings of ``--llm`` if it is a model."""
    from agentspec.policies import Policy

    policy = Policy.parse(text)
    if policy.scripted:
        return policy
    return Policy(policy.name, policy.model, policy.adapter, key_values(arguments.llm, "--llm"))


__all__ = [
    "add_environment",
    "add_model",
    "environment_options",
    "key_values",
    "labelled_spec",
    "load_prices",
    "parse_policy",
    "parse_seeds",
]
