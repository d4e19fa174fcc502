"""Scripted players: what an environment offers as its expert, and as its player of random sensible actions.

An environment names them in the class attribute `experts`, role -> "module:factory":

    class MyWorld(gymnasium.Env):
        experts = {"rule_based": "my_package.my_world.expert:expert"}

A factory is called with the task's environment options and a generator, `factory(options, rng, **parameters)`, and
returns a `Player`. The reasoners `rule_based` and `random` play whatever the environment of their task names here.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from agentspec.importing import import_name
from agentspec.registry import SpecError
from agentspec.state import dump_random, load_random

Factory = Callable[..., "Player"]


class Player(Protocol):
    """Plays by rules, without a model."""

    def act(self, info: Mapping[str, Any]) -> str:
        """The next action as text, from `info["state"]` and `info["action_schema"]` of reset or step."""
        ...

    def snapshot(self) -> bytes:
        """What it remembers, for `restore`."""
        ...

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`."""
        ...


class Chance:
    """Uniform draws from what `offered` finds in the `info` of reset or step: a player of random actions."""

    def __init__(self, rng: random.Random, offered: Callable[[Mapping[str, Any]], Sequence[str]]) -> None:
        self._rng, self._offered = rng, offered

    def act(self, info: Mapping[str, Any]) -> str:
        """A random action."""
        return self._rng.choice(self._offered(info))

    def snapshot(self) -> bytes:
        """The generator's state."""
        return dump_random(self._rng)

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`."""
        load_random(self._rng, blob)


class NoPlayer(SpecError):  # noqa: N818 - read as a sentence in the message of a run
    """An environment that has no player of this role."""


def roles(env: str) -> dict[str, str]:
    """Role -> "module:factory", as the class of an environment declares them; empty where it declares none."""
    from agentspec.envs.making import environment_class

    return dict(getattr(environment_class(env), "experts", {}))


def player(env: str, role: str, options: Mapping[str, Any], rng: random.Random, **parameters: Any) -> Player:
    """The player of `role` for one episode of the environment `env` (a name or id) made with `options`.

    Raises:
        NoPlayer: the environment declares none of this role.
        TypeError: the player does not take one of the parameters.
    """
    declared = roles(env)
    if role not in declared:
        raise NoPlayer(f"{env} has no player {role!r} (it has: {', '.join(declared) or 'none'}); choose a model")
    factory: Factory = import_name(declared[role])
    return factory(options, rng, **parameters)


__all__ = ["Chance", "NoPlayer", "Player", "player", "roles"]
