"""The environments: each a versioned `gymnasium.Env`, registered when this package is imported."""

from __future__ import annotations

import gymnasium

ENTRY_POINTS = {
    "agentspec/DeliveryBench-v0": "agentspec.envs.deliverybench.env:DeliveryBenchEnv",
    "agentspec/DeliveryBenchDiscrete-v0": "agentspec.envs.deliverybench.discrete:make",
}
"""Environment id -> where its class is; the class is imported only when the environment is made."""

STEP_LIMITS = {"agentspec/DeliveryBench-v0": 5000, "agentspec/DeliveryBenchDiscrete-v0": 5000}
"""Environment id -> steps after which every episode is cut."""


def register_all() -> None:
    """Register every environment with gymnasium; registering again changes nothing."""
    for name, entry_point in ENTRY_POINTS.items():
        if name not in gymnasium.registry:
            # The passive checker would validate every observation of every step; the test suite checks them instead.
            limit = STEP_LIMITS.get(name)
            gymnasium.register(name, entry_point, max_episode_steps=limit, disable_env_checker=True)


register_all()
