"""The courier for classical reinforcement learning: a `Discrete` action for each place of the menu, numbers to look at.

    env = gymnasium.make("agentspec/DeliveryBenchDiscrete-v0", size="small")
    observation, info = env.reset(seed=0)
    action = env.action_space.sample(info["action_mask"])

`info["action_mask"]` (int8, one entry per action) tells which places of the menu are filled. An empty place is an
answer that is no choice: it costs a step and changes nothing. `MenuActions` and `Numbers` are wrappers and can be used
alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.choices import DRINK, KINDS, MAX_ORDERS, PACK, Option
from agentspec.envs.deliverybench.view.menu import MAX_CHOICES
from agentspec.envs.deliverybench.world.rules import MODES

COURIER = 13 + len(MODES)
SLOT = 4 + len(KINDS)
LIMIT = 10.0
"""All numbers are scaled to about 1 and cut here."""


class MenuActions(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Action i is the i-th choice of the menu.

    Args:
        env: a `DeliveryBenchEnv` in menu mode, wrapped or not.

    Raises:
        ValueError: it is not in menu mode.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        if not getattr(env.unwrapped, "menu_mode", False):
            raise ValueError('MenuActions needs an environment with a menu; make it with action_mode="menu"')
        self.action_space = spaces.Discrete(MAX_CHOICES)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a shift."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, self._masked(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take the choice of that number."""
        choices = self._choices
        text = choices[int(action)] if 0 <= int(action) < len(choices) else f"choice {int(action)} of {len(choices)}"
        observation, reward, terminated, truncated, info = self.env.step(text)
        return observation, reward, terminated, truncated, self._masked(info)

    def _masked(self, info: dict[str, Any]) -> dict[str, Any]:
        self._choices: tuple[str, ...] = info["action_schema"].choices
        mask = np.zeros(MAX_CHOICES, np.int8)
        mask[: len(self._choices)] = 1
        return {**info, "action_mask": mask}


class Numbers(gymnasium.Wrapper[npt.NDArray[np.float32], Any, Any, Any]):
    """The situation and the menu as one vector of `COURIER + MAX_CHOICES * SLOT` numbers.

    First the courier: shift left, energy, battery, earnings, open and fetched orders, full hands, car, charging,
    drinks, packs, next deadline, page, and the way of travelling (one of `MODES`). Then for each place of the menu:
    filled or not, way, time and dollars (see `Option`), and its kind (one of `KINDS`).
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        size = COURIER + MAX_CHOICES * SLOT
        self.observation_space = spaces.Box(-LIMIT, LIMIT, (size,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start a shift."""
        _, info = self.env.reset(seed=seed, options=options)
        return self._numbers(info), info

    def step(self, action: Any) -> tuple[npt.NDArray[np.float32], Any, bool, bool, dict[str, Any]]:
        """Carry out an action."""
        _, reward, terminated, truncated, info = self.env.step(action)
        return self._numbers(info), reward, terminated, truncated, info

    def _numbers(self, info: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        env = self.unwrapped
        assert isinstance(env, DeliveryBenchEnv)
        numbers = [*_courier(info["state"], env.page)]
        for option in env.menu:
            numbers += _slot(option)
        numbers += [0.0] * (COURIER + MAX_CHOICES * SLOT - len(numbers))
        return np.clip(np.asarray(numbers, np.float32), -LIMIT, LIMIT)


def _courier(view: Mapping[str, Any], page: int) -> list[float]:
    orders = view["orders"]
    return [
        view["left_s"] / 3600.0,
        view["energy"] / 100.0,
        view["battery"] / 100.0,
        view["net_earnings"] / 100.0,
        len(orders) / MAX_ORDERS,
        sum(order["picked"] for order in orders) / MAX_ORDERS,
        float(calls.hands_full(view)),
        float(view["car"] is not None),
        float(view["charging"] is not None),
        view["inventory"].get(DRINK, 0) / 4.0,
        view["inventory"].get(PACK, 0) / 4.0,
        min((order["time_left_s"] for order in orders), default=600.0) / 600.0,
        page / 4.0,
        *(float(view["mode"] == mode) for mode in MODES),
    ]


def _slot(option: Option) -> list[float]:
    scaled = [1.0, option.metres / 1000.0, option.seconds / 600.0, option.dollars / 10.0]
    return scaled + [float(option.kind == kind) for kind in KINDS]


def make(*, observation: str = "numbers", **options: Any) -> gymnasium.Env[Any, Any]:
    """The registered environment: `DeliveryBenchEnv` in menu mode behind `MenuActions`.

    Args:
        observation: "numbers" (see `Numbers`), or "compact" or "full" for texts.
        options: further arguments of `DeliveryBenchEnv`.

    Raises:
        ValueError: another observation, or an action mode that is not the menu.
    """
    if observation not in ("numbers", "compact", "full"):
        raise ValueError(f"observation is {observation!r}; expected one of 'numbers', 'compact', 'full'")
    if options.setdefault("action_mode", "menu") != "menu":
        raise ValueError(f"action_mode is {options['action_mode']!r}; discrete actions need the menu")
    text: Any = "compact" if observation == "numbers" else observation
    env = MenuActions(DeliveryBenchEnv(observation=text, **options))
    return Numbers(env) if observation == "numbers" else env


__all__ = ["MenuActions", "Numbers", "make"]
