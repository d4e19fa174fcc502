"""From a name to an environment: registered short names, gymnasium ids, and `module:Id-v0`.

An environment that keeps the contract (`agentspec.envs.contract`) is used as it is. Any other one is put behind the
adapter of `agentspec.envs.generic`, which gives it text, a menu of its actions and the keys of `info`.
"""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Mapping
from typing import Any

import gymnasium

from agentspec.actions import suggest
from agentspec.importing import import_name, look_here
from agentspec.parameters import check_types
from agentspec.registry import REGISTRY, SpecError
from agentspec.types import Task

PROVIDERS = {"MiniGrid": "minigrid", "BabyAI": "minigrid", "MiniWorld": "miniworld", "ALE": "ale_py"}
"""First part of an id -> the module that registers such ids when it is imported."""


def short_names() -> Mapping[str, str]:
    """Registered short name -> gymnasium id."""
    return {name: entry.target for name, entry in REGISTRY.all("env").items()}


def environment_id(name: str) -> str:
    """The gymnasium id of a registered short name; ids pass through, `module:Id-v0` imports the module first.

    Raises:
        SpecError: unknown, with the nearest names, or a module that is not there.
    """
    ours = short_names()
    if name in ours:
        return ours[name]
    module, _, plain = name.rpartition(":")
    if plain not in gymnasium.registry:
        module = module or PROVIDERS.get(re.split(r"[-/]", plain)[0], "")
    if module:
        _import(module, name)
    if plain in gymnasium.registry:
        return plain
    raise SpecError(f"unknown env {name!r}{_near(plain)}")


def make_env(task: Task) -> Any:
    """The environment of `task`, adapted if it does not speak text.

    Raises:
        SpecError: an unknown environment, with the nearest names, options it does not take, or actions that no text
            can name.
    """
    from agentspec.envs.generic import adapted

    name = environment_id(task.env)
    check_options(name, task.options)
    mode = task.options.get("render_mode")
    if not isinstance(mode, str | None):
        raise SpecError(f"env {name!r}: render_mode must be a text or null, got {mode!r}")
    try:
        env = gymnasium.make(name, disable_env_checker=True, **task.options)
    except TypeError as error:
        raise SpecError(f"{name} refused its options {dict(task.options)}: {error}") from error
    except gymnasium.error.DependencyNotInstalled as error:
        raise SpecError(f"{name} needs a package that is not installed: {error}") from error
    return adapted(env, name)


def check_options(name: str, options: Mapping[str, Any]) -> None:
    """Refuse options that nobody takes, and of our own environments those of another type.

    Raises:
        SpecError: with the nearest options there are.
    """
    made = environment_class(name)
    if made is None:
        return
    accepted = inspect.signature(made).parameters
    if all(p.kind is not p.VAR_KEYWORD for p in accepted.values()):
        for key in options:
            if key not in accepted and key not in inspect.signature(gymnasium.make).parameters:
                raise SpecError(f"env {name!r} takes no option {key!r}{suggest(key, accepted)}")
    if made.__module__.partition(".")[0] == __name__.partition(".")[0]:
        check_types(f"env {name!r}", made.__init__ if inspect.isclass(made) else made, options)


def environment_class(name: str) -> Any:
    """The class (or function) that makes an environment, or `None` if there is none of this name or it cannot load.

    Names may come from recorded rows: unlike `environment_id`, this imports no module that a name asks for.
    """
    plain = short_names().get(name) or name.rpartition(":")[2]
    try:
        entry_point = gymnasium.registry[plain].entry_point
        return import_name(entry_point) if isinstance(entry_point, str) else entry_point
    except (KeyError, SpecError):
        return None


def _import(module: str, name: str) -> None:
    look_here()
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise
        raise SpecError(
            f"env {name!r}: there is no module {module!r} here; install its package, or start where it lies"
        ) from error


def _near(name: str) -> str:
    """A hint: the nearest of our names and of all gymnasium ids; ours alone where none is near."""
    ours = list(short_names())
    hint = suggest(name, [*ours, *gymnasium.registry])
    return hint if hint.startswith("; did you mean") else f"{suggest(name, ours)}, any gymnasium id, or module:Id-v0"
