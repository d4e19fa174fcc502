"""The environments: each a versioned `gymnasium.Env`, registered when this package is imported."""

from __future__ import annotations

import gymnasium

from agentspec.registry import register

ENTRY_POINTS = {
    "agentspec/DeliveryBench-v0": "agentspec.envs.deliverybench.env:DeliveryBenchEnv",
}
"""Environment id -> where its class is; the class is imported only when the environment is made."""


def register_all() -> None:
    """Register every environment with gymnasium; registering again changes nothing."""
    for name, entry_point in ENTRY_POINTS.items():
        if name not in gymnasium.registry:
            # The passive checker would validate every observation of every step; the test suite checks them instead.
            gymnasium.register(id=name, entry_point=entry_point, disable_env_checker=True)


register_all()
register(
    "env",
    "deliverybench",
    "agentspec/DeliveryBench-v0",
    "a courier earns money in a city: orders, deadlines, battery, energy, hot and cold food",
)
