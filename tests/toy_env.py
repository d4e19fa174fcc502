"""A tiny text environment for tests of the scaffold and the trainers: sell for the price shown, or wait.

The price follows a fixed sequence that depends on the seed; SELL pays it once, WAIT pays nothing; five steps.
"""

from __future__ import annotations

import random
import string
import time
from typing import Any

import gymnasium
from gymnasium import spaces

from agentspec.actions import parse_action
from agentspec.metrics import Metric
from agentspec.state import dump_state, load_state
from agentspec.types import ActionError, ActionSchema, ActionSpec

ACTIONS = {
    "SELL": ActionSpec("SELL", "sell at the price shown", example="SELL()"),
    "WAIT": ActionSpec("WAIT", "do nothing", example="WAIT()"),
}


class ToyEnv(gymnasium.Env[dict[str, Any], str]):
    observation_space = spaces.Dict({"text": spaces.Text(200, charset=string.printable)})
    action_space = spaces.Text(100)
    metadata = {  # noqa: RUF012
        "render_modes": [],
        "metrics": (Metric("net_earnings", "$"), Metric("deliveries")),
        "typical_return": 25.0,  # five prices of 5 on average
    }

    def __init__(self, steps: int = 5, menu: bool = False, fault: str = "", fault_step: int = 2) -> None:
        self.steps, self.menu, self.fault, self.fault_step = steps, menu, fault, fault_step
        self.t = 0
        self.balance = 0.0
        self.prices: list[int] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        rng = random.Random(seed)
        self.prices = [rng.randint(1, 9) for _ in range(self.steps + 1)]
        self.t, self.balance = 0, 0.0
        return self._observation(), self._info("", False)

    def step(self, action: str) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.fault and self.t == self.fault_step:
            if self.fault == "crash":
                raise RuntimeError("the toy broke")
            if self.fault == "hang":
                time.sleep(30)
        if self.t >= self.steps:
            return self._observation(), 0.0, True, False, self._info("", False)
        parsed = parse_action(action, self._schema())
        price = self.prices[self.t]
        self.t += 1
        error = parsed.message if isinstance(parsed, ActionError) else ""
        sells = not isinstance(parsed, ActionError) and parsed.name.upper().startswith("SELL")
        reward = float(price) if sells else 0.0
        if self.fault == "nan" and self.t == self.fault_step + 1:
            reward = float("nan")
        self.balance += reward
        done = self.t >= self.steps
        return self._observation(), reward, done, False, self._info(error, bool(error))

    def snapshot(self) -> bytes:
        return dump_state([self.t, self.balance, self.prices])

    def restore(self, blob: bytes) -> None:
        self.t, self.balance, self.prices = load_state(blob)

    def _schema(self) -> ActionSchema:
        choices = ("sell now", "wait a step") if self.menu else ()
        return ActionSchema(ACTIONS, choices=choices)

    def _observation(self) -> dict[str, Any]:
        menu = " Actions: sell now; wait a step." if self.menu else ""
        return {"text": f"Step {self.t}. The price is {self.prices[self.t]}.{menu}"}

    def _info(self, error: str, invalid: bool) -> dict[str, Any]:
        return {
            "instruction": "You trade. Earn as much as you can.",
            "action_schema": self._schema(),
            "state": {"t": self.t, "price": self.prices[self.t]},
            "balance": self.balance,
            "error": error,
            "message": "" if error else "ok",
            "invalid": invalid,
            "metrics": {"net_earnings": self.balance, "deliveries": 0},
        }


TOY = "agentspec-test/Toy-v0"
if TOY not in gymnasium.registry:
    gymnasium.register(TOY, entry_point="tests.toy_env:ToyEnv")
