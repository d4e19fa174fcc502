"""One ranking out of several. A ranking is a list of (key, score), best first; ties keep the order of rankings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

Ranking = Sequence[tuple[int, float]]


def reciprocal_rank_fusion(rankings: Sequence[Ranking], *, constant: float = 60.0) -> list[tuple[int, float]]:
    """Sum of 1 / (constant + rank), ranks counted from 1 (Cormack et al., 2009).

    >>> [(k, round(v, 4)) for k, v in reciprocal_rank_fusion([[(7, 0.9), (8, 0.5)], [(9, 3.0), (8, 2.0), (7, 1.0)]])]
    [(7, 0.0323), (8, 0.0323), (9, 0.0164)]
    """
    fused: dict[int, float] = {}
    for ranking in rankings:
        for rank, (key, _) in enumerate(ranking, start=1):
            fused[key] = fused.get(key, 0.0) + 1.0 / (constant + rank)
    return _sorted(fused)


def weighted_fusion(rankings: Sequence[tuple[float, Ranking]]) -> list[tuple[int, float]]:
    """Weighted sum of scores, each ranking's scaled to [0, 1] by `min_max`; a key it lacks scores 0 in it."""
    fused: dict[int, float] = {}
    for weight, ranking in rankings:
        for key, value in min_max(dict(ranking)).items():
            fused[key] = fused.get(key, 0.0) + weight * value
    return _sorted(fused)


def min_max(scores: Mapping[int, float]) -> dict[int, float]:
    """Scores scaled to [0, 1]; all 0.5 where they are equal.

    >>> min_max({1: 2.0, 2: 4.0, 3: 3.0})
    {1: 0.0, 2: 1.0, 3: 0.5}
    """
    if not scores:
        return {}
    low, high = min(scores.values()), max(scores.values())
    if high == low:
        return dict.fromkeys(scores, 0.5)
    return {key: (value - low) / (high - low) for key, value in scores.items()}


def mmr(
    ranking: Ranking, similarity: Callable[[int, int], float], k: int, *, relevance: float = 0.7
) -> list[tuple[int, float]]:
    """Maximal marginal relevance (Carbonell and Goldstein, 1998): what is relevant and unlike what was already chosen.

    Args:
        similarity: of two keys, in [-1, 1].
        relevance: weight of the score against the greatest similarity to a chosen key.

    Returns:
        at most `k` pairs of key and original score, in the order they were chosen.
    """
    left, chosen = list(ranking), list[tuple[int, float]]()
    while left and len(chosen) < k:

        def value(item: tuple[int, float]) -> float:
            near = max((similarity(item[0], key) for key, _ in chosen), default=0.0)
            return relevance * item[1] - (1 - relevance) * near

        best = max(left, key=value)
        left.remove(best)
        chosen.append(best)
    return chosen


def _sorted(fused: Mapping[int, float]) -> list[tuple[int, float]]:
    return sorted(fused.items(), key=lambda item: -item[1])
