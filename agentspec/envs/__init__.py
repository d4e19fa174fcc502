"""The environments: each a versioned `gymnasium.Env` in a folder of its own, which registers it when this is imported.

What an environment owes the scaffold stands in `agentspec.envs.contract`; `check_environment` holds one against it.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agentspec.envs.contract import ContractError, check_environment
    from agentspec.envs.making import environment_id, make_env

_PUBLIC = {
    "ContractError": "agentspec.envs.contract",
    "check_environment": "agentspec.envs.contract",
    "environment_id": "agentspec.envs.making",
    "make_env": "agentspec.envs.making",
}

__all__ = ["ContractError", "check_environment", "environment_id", "make_env"]


def __getattr__(name: str) -> Any:
    """The public functions, imported when they are asked for: registering must stay cheap."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), name)


for _found in pkgutil.iter_modules(__path__):
    if _found.ispkg:
        importlib.import_module(f"{__name__}.{_found.name}")
