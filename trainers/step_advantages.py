"""Step-level credit: one advantage per environment step instead of one per episode.

Input is ragged: for each rollout of one group its rewards per step, or ``None`` where it could not be scored. The
result has the same shape. Tokens get the advantage of the step they were sampled in.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Hashable, Sequence

from trainers.advantages import EPSILON

Steps = Sequence[Sequence[float] | None]


def discounted(rewards: Sequence[float], gamma: float) -> list[float]:
    """Discounted reward-to-go of each step.

    >>> discounted([1.0, 0.0, 2.0], 0.5)
    [1.5, 1.0, 2.0]
    """
    togo, running = [0.0] * len(rewards), 0.0
    for t in range(len(rewards) - 1, -1, -1):
        running = rewards[t] + gamma * running
        togo[t] = running
    return togo


def reward_to_go(group: Steps, *, gamma: float = 1.0, tolerance: float = 1e-6) -> list[list[float]]:
    """Discounted reward-to-go, centred per step over the group and scaled by the group's deviation.

    The baseline of step t is the mean over all scorable rollouts; one that has ended earns nothing more, so it counts
    with 0. The deviation is that of all centred values of the group (sample deviation).
    """
    togo = [None if r is None else discounted(r, gamma) for r in group]
    scored = [g for g in togo if g is not None]
    longest = max(map(len, scored), default=0)
    means = [math.fsum(g[t] if t < len(g) else 0.0 for g in scored) / len(scored) for t in range(longest)]
    centred = [[] if g is None else [v - m for v, m in zip(g, means, strict=False)] for g in togo]
    return _scaled(centred, len(scored), tolerance)


def gigpo(
    group: Steps,
    anchors: Sequence[Sequence[Hashable]],
    *,
    gamma: float = 1.0,
    weight: float = 1.0,
    tolerance: float = 1e-6,
) -> list[list[float]]:
    """Group-in-group (Feng et al., 2025): the episode's advantage plus that of the step among equal states.

    Args:
        anchors: per rollout and step the state the action was taken in; steps of the group with equal anchors form a
            step group, in which their rewards-to-go are normalised. A state met once has step advantage 0.
        weight: of the step advantage.
    """
    totals = [None if r is None else math.fsum(r) for r in group]
    episode = _normalised([t for t in totals if t is not None], tolerance)
    togo = [[] if r is None else discounted(r, gamma) for r in group]
    members: dict[Hashable, list[tuple[int, int]]] = defaultdict(list)
    for i, (values, states) in enumerate(zip(togo, anchors, strict=True)):
        if values and len(states) != len(values):
            raise ValueError(f"rollout {i} has {len(values)} steps and {len(states)} anchor states")
        for t in range(len(values)):
            members[states[t]].append((i, t))
    result = [[0.0] * len(values) for values in togo]
    for places in members.values():
        for (i, t), value in zip(places, _normalised([togo[i][t] for i, t in places], tolerance), strict=True):
            result[i][t] = weight * value
    own = iter(episode)
    for i, total in enumerate(totals):
        if total is not None:
            base = next(own)
            result[i] = [base + value for value in result[i]]
    return result


def _normalised(values: Sequence[float], tolerance: float) -> list[float]:
    """Centred, over the sample deviation (0 where there is no variance)."""
    mean = math.fsum(values) / len(values) if values else 0.0
    return _scaled([[v - mean for v in values]], len(values), tolerance)[0]


def _scaled(centred: list[list[float]], members: int, tolerance: float) -> list[list[float]]:
    """Divide by the sample deviation of all values; zeros where it is at most ``tolerance`` or one member is alone."""
    flat = [v for values in centred for v in values]
    if members < 2 or len(flat) < 2:
        return [[0.0] * len(values) for values in centred]
    deviation = math.sqrt(math.fsum(v * v for v in flat) / (len(flat) - 1))
    if deviation <= tolerance:
        return [[0.0] * len(values) for values in centred]
    return [[v / (deviation + EPSILON) for v in values] for values in centred]
