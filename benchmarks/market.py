"""A small text world for benchmarks: sell at the price shown, or wait.

Every observation has the same number of words, an episode lasts exactly ``steps`` actions whatever the agent writes,
and a call can be made to take ``delay_s`` seconds or to fail: what a benchmark varies, and nothing else.
"""

from __future__ import annotations

import random
import time
from typing import Any

import gymnasium
from gymnasium import spaces

from agentspec.actions import parse_action
from agentspec.types import ActionError, ActionSchema, ActionSpec

ACTIONS = {
    "SELL": ActionSpec("SELL", "sell at the price shown", example="SELL()"),
    "WAIT": ActionSpec("WAIT", "do nothing", example="WAIT()"),
}
WORDS = ("stalls", "carts", "bread", "apples", "rain", "crowd", "bells", "smoke", "coins", "cloth")
MARKET = "agentspec-benchmarks/Market-v0"


class MarketEnv(gymnasium.Env[dict[str, Any], str]):
    """The market.

    Args:
        steps: actions of an episode.
        words: words of news in every observation.
        menu: offer the two actions as choices.
        delay_s: seconds that every ``step`` takes.
        fault: ``crash``, ``hang`` or ``nan`` at the second step; empty: none.
    """

    observation_space = spaces.Dict({"text": spaces.Text(4000)})
    action_space = spaces.Text(1000)

    def __init__(
        self, steps: int = 8, words: int = 20, menu: bool = False, delay_s: float = 0.0, fault: str = ""
    ) -> None:
        self.steps, self.words, self.menu, self.delay_s, self.fault = steps, words, menu, delay_s, fault
        choices = ("sell now", "wait a step") if menu else ()
        self._schema = ActionSchema(ACTIONS, choices=choices)
        self._rng = random.Random(0)
        self._t, self._price, self._balance = 0, 0, 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """A new day; ``seed`` decides prices and news."""
        super().reset(seed=seed)
        self._rng = random.Random(seed)
        self._t, self._balance = 0, 0.0
        self._price = self._rng.randint(1, 9)
        return self._observation(), self._info("")

    def step(self, action: str) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Sell or wait; what is no action counts as waiting."""
        if self.delay_s:
            time.sleep(self.delay_s)
        if self.fault and self._t == 1:
            if self.fault == "crash":
                raise RuntimeError("the market burnt down")
            if self.fault == "hang":
                time.sleep(20)
        parsed = parse_action(action, self._schema)
        error = parsed.message if isinstance(parsed, ActionError) else ""
        reward = 0.0 if error or not str(parsed.name).upper().startswith("SELL") else float(self._price)  # type: ignore[union-attr]
        if self.fault == "nan" and self._t == 1:
            reward = float("nan")
        self._balance += reward
        self._t += 1
        self._price = self._rng.randint(1, 9)
        return self._observation(), reward, self._t >= self.steps, False, self._info(error)

    def _observation(self) -> dict[str, Any]:
        news = " ".join(self._rng.choice(WORDS) for _ in range(self.words))
        menu = " Actions: sell now; wait a step." if self.menu else ""
        return {"text": f"Step {self._t:03d}. The price is {self._price}. {news}.{menu}"}

    def _info(self, error: str) -> dict[str, Any]:
        return {
            "instruction": "You trade on a market. Earn as much as you can.",
            "action_schema": self._schema,
            "state": {"t": self._t, "price": self._price},
            "balance": self._balance,
            "error": error,
            "message": "" if error else "ok",
            "invalid": bool(error),
            "metrics": {"net_earnings": self._balance, "deliveries": 0},
        }


if MARKET not in gymnasium.registry:
    gymnasium.register(MARKET, entry_point=MarketEnv)
