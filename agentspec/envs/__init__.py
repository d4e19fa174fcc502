"""The environments: each a versioned `gymnasium.Env`, registered when this package is imported.

What an environment owes the scaffold stands in `agentspec.envs.contract`; `check_environment` holds one against it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium

from agentspec.registry import register

if TYPE_CHECKING:
    from agentspec.envs.contract import ContractError, check_environment
    from agentspec.envs.making import environment_id, make_env

ENTRY_POINTS = {
    "agentspec/DeliveryBench-v0": "agentspec.envs.deliverybench.env:DeliveryBenchEnv",
    "agentspec/MiniGrid-v0": "agentspec.envs.minigrid.env:MiniGridEnv",
    "agentspec/Alfred-v0": "agentspec.envs.alfred.env:AlfredEnv",
    "agentspec/RoboThor-v0": "agentspec.envs.robothor.env:RoboThorEnv",
}
"""Environment id -> where its class is; the class is imported only when the environment is made."""

NUMERIC = {
    "agentspec/DeliveryBenchDiscrete-v0": "agentspec.envs.deliverybench.discrete:make",
}
"""The same worlds with numbers for actions and observations, for other libraries; agents play the ones above."""

STEP_LIMITS = {"agentspec/DeliveryBench-v0": 5000, "agentspec/DeliveryBenchDiscrete-v0": 5000}
"""Environment id -> steps after which every episode is cut."""

_PUBLIC = {
    "ContractError": "agentspec.envs.contract",
    "check_environment": "agentspec.envs.contract",
    "environment_id": "agentspec.envs.making",
    "make_env": "agentspec.envs.making",
}

__all__ = [
    "ENTRY_POINTS",
    "NUMERIC",
    "STEP_LIMITS",
    "ContractError",
    "check_environment",
    "environment_id",
    "make_env",
    "register_all",
]


def register_all() -> None:
    """Register every environment with gymnasium; registering again changes nothing."""
    for name, entry_point in {**ENTRY_POINTS, **NUMERIC}.items():
        if name not in gymnasium.registry:
            # The passive checker would validate every observation of every step; the test suite checks them instead.
            limit = STEP_LIMITS.get(name)
            gymnasium.register(name, entry_point, max_episode_steps=limit, disable_env_checker=True)


def __getattr__(name: str) -> Any:
    """The public functions, imported when they are asked for: registering must stay cheap."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_PUBLIC[name]), name)


register_all()
register(
    "env",
    "deliverybench",
    "agentspec/DeliveryBench-v0",
    "a courier earns money in a city: orders, deadlines, battery, energy, hot and cold food",
)
register(
    "env",
    "minigrid",
    "agentspec/MiniGrid-v0",
    "MiniGrid and BabyAI grids: egocentric text, success within 100 steps, the paper's ten tasks",
)
register(
    "env",
    "alfred",
    "agentspec/Alfred-v0",
    "ALFRED household tasks: find, carry, heat, cool, clean, slice, within 200 steps",
)
register(
    "env",
    "robothor",
    "agentspec/RoboThor-v0",
    "RoboTHOR object navigation: find an object of a class in an apartment and stop, within 200 steps",
)
