"""The toy environment with steps that take a little time, so that a kill meets episodes under way."""

from __future__ import annotations

import time
from typing import Any

import gymnasium

from tests.toy_env import ToyEnv

SLOW = "agentspec-test/SlowToy-v0"


class SlowToy(ToyEnv):
    """Each step takes a hundredth of a second."""

    def step(self, action: str) -> Any:
        """As the toy's, later."""
        time.sleep(0.01)
        return super().step(action)


if SLOW not in gymnasium.registry:
    gymnasium.register(SLOW, entry_point="tests.eval.slow_toy:SlowToy")
