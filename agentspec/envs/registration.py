"""How an environment of this package makes itself known: its folder's `__init__.py` calls `register_env`."""

from __future__ import annotations

import gymnasium

from agentspec.registry import register


def register_env(
    id: str, entry_point: str, *, name: str = "", summary: str = "", max_episode_steps: int | None = None
) -> None:
    """Register an environment with gymnasium and, if it has a `name`, for specs, `--env` and `agentspec list`.

    Registering again changes nothing.

    Args:
        id: versioned, `agentspec/World-v0`.
        entry_point: "module:Class", imported only when the environment is made.
        name: its short name; empty for a variant that agents do not play (numbers for other libraries, say).
        summary: one line about it.
        max_episode_steps: steps after which every episode is cut.
    """
    if id not in gymnasium.registry:
        # The passive checker would validate every observation of every step; the test suite checks them instead.
        gymnasium.register(id, entry_point, max_episode_steps=max_episode_steps, disable_env_checker=True)
    if name:
        register("env", name, id, summary)
