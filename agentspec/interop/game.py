"""One episode as a conversation: texts in, texts out, and what it came to. What every adapter stands on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agentspec.envs.making import make_env
from agentspec.metrics import number
from agentspec.types import ActionSchema, Task

OVER = "The episode is over."


class Game:
    """Plays episodes of one environment, one after the other.

    Args:
        env: a registered name or id (see `agentspec.envs.making`).
        options: of the environment.
    """

    def __init__(self, env: str, options: Mapping[str, Any] | None = None) -> None:
        self._env = make_env(Task(env, 0, dict(options or {})))
        self.steps = 0
        self.total = 0.0
        self.reward = 0.0
        self.over = False
        self.info: Mapping[str, Any] = {}

    def start(self, seed: int = 0) -> str:
        """A new episode; its first observation."""
        observation, self.info = self._env.reset(seed=seed)
        self.steps, self.total, self.reward, self.over = 0, 0.0, 0.0, False
        return str(observation["text"])

    def act(self, text: str) -> str:
        """One step; what is observed after it, with what was wrong with the text, if anything was.

        Raises:
            RuntimeError: before the first `start`.
        """
        if not self.info:
            raise RuntimeError("act() before start(): there is no episode yet")
        if self.over:
            self.reward = 0.0  # what the last step earned is paid once
            return OVER
        observation, reward, terminated, truncated, self.info = self._env.step(text)
        self.steps += 1
        self.reward = float(reward)
        self.total += self.reward
        self.over = bool(terminated or truncated)
        shown = str(observation["text"])
        return f"{shown}\n{OVER}" if self.over else shown

    @property
    def instruction(self) -> str:
        """The static part of the prompt: world, rules, aim."""
        return str(self.info["instruction"])

    @property
    def schema(self) -> ActionSchema:
        """What can be done now."""
        schema: ActionSchema = self.info["action_schema"]
        return schema

    @property
    def metrics(self) -> dict[str, float]:
        """The numbers among the environment's metrics."""
        found = {name: number(value) for name, value in self.info["metrics"].items()}
        return {name: value for name, value in found.items() if value is not None}

    def score(self, name: str = "return") -> float:
        """The sum of rewards (`return`), or one of the environment's metrics; one that is not there yet counts 0.

        Raises:
            KeyError: the environment has no metric of this name.
        """
        if name == "return":
            return self.total
        if name not in self.info["metrics"]:
            known = ", ".join(["return", *self.info["metrics"]])
            raise KeyError(f"no score {name!r}; expected one of {known}")
        return self.metrics.get(name, 0.0)

    def close(self) -> None:
        """Let go of the environment."""
        self._env.close()
