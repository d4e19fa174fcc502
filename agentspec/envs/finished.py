"""After the end nothing happens: what `gymnasium.make`'s limit of steps does not ensure by itself."""

from __future__ import annotations

from typing import Any

import gymnasium


class FinishedEpisode(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Repeats the last report, without reward, once an episode has ended or was cut off by a wrapper beneath.

    An environment that is registered with `max_episode_steps` does not know of its limit and would go on.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self._last: tuple[Any, bool, bool, dict[str, Any]] | None = None

    def reset(self, **settings: Any) -> Any:
        """Start an episode."""
        self._last = None
        return self.env.reset(**settings)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act, unless the episode is over."""
        if self._last is not None:
            observation, terminated, truncated, info = self._last
            return observation, 0.0, terminated, truncated, info
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            self._last = (observation, terminated, truncated, info)
        return observation, float(reward), terminated, truncated, info
