"""Means with bootstrap intervals, and differences on paired seeds.

Episodes of one benchmark differ far more between tasks (a good or a bad day for orders) than between policies. All
policies therefore play the same tasks, and two of them are compared by the mean of their *differences per task*. The
unit that is resampled is the task: several rollouts of one task are averaged first.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

RESAMPLES = 10_000
K = TypeVar("K", bound=Hashable)

CHUNK = 1 << 20
"""Most resampled indices held in memory at once."""


@dataclass(frozen=True)
class Estimate:
    """A mean over ``n`` tasks and its interval; NaN where there is nothing to estimate from.

    With one task there is a mean but no interval (``low`` and ``high`` are NaN).
    """

    mean: float
    low: float
    high: float
    n: int

    def to_data(self) -> dict[str, Any]:
        """JSON values: NaN becomes ``None``."""
        return {
            "mean": None if math.isnan(self.mean) else self.mean,
            "low": None if math.isnan(self.low) else self.low,
            "high": None if math.isnan(self.high) else self.high,
            "n": self.n,
        }


def bootstrap(values: Sequence[float], *, level: float = 0.95, resamples: int = RESAMPLES, seed: int = 0) -> Estimate:
    """Mean of ``values`` and its percentile bootstrap interval (Efron 1979).

    Args:
        values: one number per task.
        level: coverage of the interval, between 0 and 1.
        resamples: number of bootstrap samples.
        seed: of the resampling; the same values and seed give the same interval.

    Raises:
        ValueError: a level outside (0, 1), no resamples, or a value that is not finite.
    """
    if not 0 < level < 1 or resamples < 1:
        raise ValueError(f"expected 0 < level < 1 and resamples >= 1, got level={level}, resamples={resamples}")
    data = np.asarray(values, dtype=np.float64)
    if not np.isfinite(data).all():
        raise ValueError(f"expected finite values, got {list(values)}; leave failed episodes out before estimating")
    n = data.size
    if n < 2:
        return Estimate(float(data[0]) if n else math.nan, math.nan, math.nan, n)
    rng = np.random.default_rng(seed)
    rows = max(1, CHUNK // n)
    means = np.concatenate(
        [
            data[rng.integers(0, n, size=(min(rows, resamples - start), n))].mean(axis=1)
            for start in range(0, resamples, rows)
        ]
    )
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(data.mean()), float(low), float(high), n)


def paired_difference(
    a: Mapping[K, float],
    b: Mapping[K, float],
    *,
    level: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Mean of ``a - b`` over the tasks that both have, with its bootstrap interval.

    Args:
        a: value by task.
        b: value by task; tasks that only one side has are left out (``n`` says how many were compared).
    """
    common = [key for key in a if key in b]
    return bootstrap([a[key] - b[key] for key in common], level=level, resamples=resamples, seed=seed)


def crossed_bootstrap(
    values: Sequence[Sequence[float]], *, level: float = 0.95, resamples: int = RESAMPLES, seed: int = 0
) -> Estimate:
    """Mean over training runs and tasks, with an interval that covers both: runs and tasks are resampled together.

    An interval over tasks alone speaks of the runs at hand; this one of another run of the same recipe. With few runs
    it is still too narrow (three of them say little about their spread), and far wider than the other.

    Args:
        values: ``values[r][t]``: one number per run and task, say the gain of run r on task t.

    Raises:
        ValueError: runs of different length, or as :func:`bootstrap`.
    """
    lengths = sorted({len(row) for row in values})
    if len(lengths) != 1:
        raise ValueError(f"expected the same tasks for every run, got runs with {lengths} tasks")
    if len(values) == 1:
        return bootstrap(values[0], level=level, resamples=resamples, seed=seed)
    data = np.asarray(values, dtype=np.float64)
    checked = bootstrap(data.mean(axis=0), level=level, resamples=1, seed=seed)
    if checked.n < 2:
        return checked
    rng = np.random.default_rng(seed)
    runs, tasks = data.shape
    means = np.empty(resamples)
    for i in range(resamples):
        drawn = data[rng.integers(0, runs, runs)].mean(axis=0)
        means[i] = drawn[rng.integers(0, tasks, tasks)].mean()
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(checked.mean, float(low), float(high), tasks)
