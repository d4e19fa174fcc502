"""The paper's reward: what a step earned, in dollars.

Per step the change of the courier's balance; over the episode the sum telescopes to net earnings.
"""

from __future__ import annotations

from agentspec.trajectory import Trajectory


def earning_delta(trajectory: Trajectory) -> tuple[float, ...]:
    """Change of ``info["balance"]`` per step; the first step is measured against the balance the episode began with.

    Raises:
        ValueError: an environment that reports no balance.
    """
    if any(t.info.get("balance") is None for t in trajectory.transitions):
        raise ValueError(
            f"earning_delta needs info['balance'] at every step; {trajectory.task.env} does not report it. "
            "Choose another reward (env, success, outcome)"
        )
    balances = [float(t.info["balance"]) for t in trajectory.transitions]
    before = [_initial_balance(trajectory), *balances[:-1]][: len(balances)]
    return tuple(b - a for a, b in zip(before, balances, strict=True))


def _initial_balance(trajectory: Trajectory) -> float:
    if not trajectory.transitions:
        return 0.0
    first = trajectory.transitions[0]
    before = first.input.state.get("balance")
    # Without a balance in the state, the environment's own reward of the first step says where it began.
    return float(before) if before is not None else float(first.info["balance"]) - first.reward
