"""A puzzle that greed does not solve: reach the target from the number shown, within a few operations.

ADD() adds 3, DOUBLE() doubles, SUB() takes 1 away. From 3 to 7 in three steps there is one way: SUB, DOUBLE, ADD
(3 -> 2 -> 4 -> 7); going nearest first (3 -> 6 -> 9) never arrives. Reaching the target pays 1 and ends the episode
as a success; running out of steps ends it as a failure.
"""

from __future__ import annotations

import itertools
import string
from typing import Any

import gymnasium
from gymnasium import spaces

from agentspec.actions import parse_action
from agentspec.state import dump_state, load_state
from agentspec.types import ActionError, ActionSchema, ActionSpec

OPERATIONS = {"ADD": lambda n: n + 3, "DOUBLE": lambda n: 2 * n, "SUB": lambda n: n - 1}
MENU = {"ADD": "add three", "DOUBLE": "double it", "SUB": "subtract one"}
ACTIONS = {name: ActionSpec(name, MENU[name], example=f"{name}()") for name in OPERATIONS}


def solve(number: int, target: int, steps: int) -> list[str] | None:
    """The shortest way by trying everything, or ``None``."""
    for length in range(1, steps + 1):
        for names in itertools.product(OPERATIONS, repeat=length):
            n = number
            for name in names:
                n = OPERATIONS[name](n)
            if n == target:
                return list(names)
    return None


def greedy(number: int, target: int) -> str:
    """The operation that comes nearest to the target at once; the first of equals."""
    return min(OPERATIONS, key=lambda name: abs(OPERATIONS[name](number) - target))


class NumbersEnv(gymnasium.Env[dict[str, Any], str]):
    observation_space = spaces.Dict({"text": spaces.Text(300, charset=string.printable)})
    action_space = spaces.Text(100)

    def __init__(self, number: int = 3, target: int = 7, steps: int = 3, menu: bool = False) -> None:
        self.start, self.target, self.limit, self.menu = number, target, steps, menu
        self.number, self.left = number, steps

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.number, self.left = self.start, self.limit
        return self._observation(), self._info("")

    def step(self, action: str) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.number == self.target or self.left <= 0:
            return self._observation(), 0.0, True, False, self._info("")
        parsed = parse_action(action, self._schema())
        self.left -= 1
        error = parsed.message if isinstance(parsed, ActionError) else ""
        if not isinstance(parsed, ActionError):
            name = next((k for k, text in MENU.items() if text == parsed.name), parsed.name)
            self.number = OPERATIONS[name](self.number)
        won = self.number == self.target
        return self._observation(), float(won), won or self.left <= 0, False, self._info(error)

    def snapshot(self) -> bytes:
        return dump_state([self.number, self.left])

    def restore(self, blob: bytes) -> None:
        self.number, self.left = load_state(blob)

    def _schema(self) -> ActionSchema:
        return ActionSchema(ACTIONS, choices=tuple(MENU.values()) if self.menu else ())

    def _observation(self) -> dict[str, Any]:
        menu = f" Actions: {'; '.join(MENU.values())}." if self.menu else ""
        return {
            "text": f"The number is {self.number}. The target is {self.target}. There are {self.left} steps left.{menu}"
        }

    def _info(self, error: str) -> dict[str, Any]:
        won = self.number == self.target
        return {
            "instruction": "Reach the target number with the operations you have.",
            "action_schema": self._schema(),
            "state": {"number": self.number, "left": self.left},
            "error": error,
            "message": error or f"the number is now {self.number}",
            "invalid": bool(error),
            "success": won,
            "metrics": {"success": won},
        }


NUMBERS = "agentspec-test/Numbers-v0"
if NUMBERS not in gymnasium.registry:
    gymnasium.register(NUMBERS, entry_point="tests.reasoning.numbers_env:NumbersEnv")


class NoSnapshots(gymnasium.Env[dict[str, Any], str]):
    """The same puzzle in an environment that cannot be put back."""

    observation_space = NumbersEnv.observation_space
    action_space = NumbersEnv.action_space

    def __init__(self, **options: Any) -> None:
        self.inner = NumbersEnv(**options)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.inner.reset(seed=seed)

    def step(self, action: str) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.inner.step(action)


ONE_WAY = "agentspec-test/NumbersOneWay-v0"
if ONE_WAY not in gymnasium.registry:
    gymnasium.register(ONE_WAY, entry_point="tests.reasoning.numbers_env:NoSnapshots")
