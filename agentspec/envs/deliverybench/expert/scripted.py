"""The players that the environment names (see `agentspec.envs.experts`)."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

from agentspec.envs.deliverybench.city.generate import city_of
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier, Style
from agentspec.envs.deliverybench.view import menu
from agentspec.envs.experts import Chance

CITY_OPTIONS = ("map", "size", "city_seed")


def expert(
    options: Mapping[str, Any], rng: random.Random, bagging: bool = True, hasty: bool = True
) -> RuleBasedCourier:
    """The rule-based courier in the city of these environment options.

    Args:
        options: arguments of the environment.
        rng: not used; the courier is deterministic.
        bagging: pack food into the bag after every pick-up.
        hasty: move at the accelerated pace while nothing fragile is carried.
    """
    city = city_of(**{name: options[name] for name in CITY_OPTIONS if name in options})
    return RuleBasedCourier(city, Style(bagging=bagging, hasty=hasty))


def luck(options: Mapping[str, Any], rng: random.Random) -> Chance:
    """A random one of the actions that make sense now."""
    return Chance(rng, lambda info: info["action_schema"].choices or [o.call for o in menu.options(info["state"])])
