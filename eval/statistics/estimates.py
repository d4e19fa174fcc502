"""Estimates over task seeds: means, paired differences, and p-values corrected over a table."""

from __future__ import annotations

import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

K = TypeVar("K", bound=Hashable)
Values = Sequence[float]

LEVEL = 0.95
RESAMPLES = 10_000
EXACT_FLIPS = 14
"""Up to this many values the sign-flip test goes through all flips (16,384); beyond, through `RESAMPLES` random
ones."""


THESE = "this checkpoint only"
"""Note of what is said over tasks: it holds for the checkpoints at hand, not for their recipe."""


@dataclass(frozen=True)
class Estimate:
    """A mean (or other location) over `n` units and its interval; NaN where there is nothing to estimate from.

    Args:
        unit: what was counted: `seed` or `run`.
        p: two-sided p-value of "it is zero", where that is a question; corrected once `holm` went over it.
        note: what a reader must know, such as `this checkpoint only`.
    """

    mean: float
    low: float
    high: float
    n: int
    unit: str = "seed"
    p: float = math.nan
    note: str = ""

    def tie(self, level: float = LEVEL) -> bool:
        """Whether no difference was shown at `level`: the p-value where there is one, else the interval, decides.

        The two may disagree: p-values are corrected over their table and intervals are not, and over tasks p is of a
        sign-flip test and the interval Student's.
        """
        if not math.isnan(self.p):
            return self.p > 1 - level
        return math.isnan(self.low) or self.low <= 0 <= self.high

    def to_data(self) -> dict[str, Any]:
        """JSON values: NaN becomes `None`."""
        numbers = {"mean": self.mean, "low": self.low, "high": self.high, "p": self.p}
        clean = {name: None if math.isnan(value) else value for name, value in numbers.items()}
        return {**clean, "n": self.n, "unit": self.unit, "note": self.note}


def mean_interval(values: Values, *, level: float = LEVEL, unit: str = "seed") -> Estimate:
    """Mean and Student's t interval; one value has no interval.

    >>> estimate = mean_interval([1.0, 2.0, 3.0])
    >>> round(estimate.low, 3), round(estimate.high, 3)
    (-0.484, 4.484)

    Raises:
        ValueError: a level outside (0, 1), or a value that is not finite.
    """
    from scipy import stats

    data = finite(values, level)
    n = data.size
    if n < 2:
        return Estimate(float(data[0]) if n else math.nan, math.nan, math.nan, n, unit)
    mean = float(data.mean())
    half = float(stats.t.ppf((1 + level) / 2, n - 1)) * float(data.std(ddof=1)) / math.sqrt(n)
    return Estimate(mean, mean - half, mean + half, n, unit)


def paired(a: Mapping[K, float], b: Mapping[K, float], *, level: float = LEVEL, seed: int = 0) -> Estimate:
    """Mean of `a - b` over the task seeds that both have: t interval, and the p-value of a sign-flip permutation test.

    Args:
        a, b: value by task seed (repeats averaged before); seeds of one side only are left out.
        seed: of the random flips, where there are too many values for all.
    """
    return over_tasks([a[key] - b[key] for key in a if key in b], level=level, seed=seed)


def over_tasks(differences: Values, *, level: float = LEVEL, seed: int = 0) -> Estimate:
    """Mean of one difference per task: t interval and sign-flip test, about the checkpoints at hand."""
    return replace(mean_interval(differences, level=level), p=sign_flip(differences, seed=seed), note=THESE)


def sign_flip(values: Values, *, seed: int = 0) -> float:
    """Two-sided p-value of "the values are symmetric about 0": the share of sign flips with a mean at least as far
    from 0.

    Exact up to `EXACT_FLIPS` values; beyond, Monte Carlo with the observed signs counted among the flips.

    >>> sign_flip([1.0, 2.0, 3.0])  # of 8 flips, all plus and all minus are as far as observed
    0.25
    """
    data = finite(values, LEVEL)
    if data.size == 0:
        return math.nan
    observed = abs(float(data.sum()))
    slack = 1e-12 * max(1.0, float(np.abs(data).sum()))
    if data.size <= EXACT_FLIPS:
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=data.size - 1)))  # the first sign does not matter
        sums = data[0] + signs @ data[1:]
        return float(np.mean(np.abs(sums) >= observed - slack))
    rng = np.random.default_rng(seed)
    sums = (rng.integers(0, 2, size=(RESAMPLES, data.size)) * 2.0 - 1.0) @ data
    return float((1 + np.sum(np.abs(sums) >= observed - slack)) / (1 + RESAMPLES))


def least_p(n: int) -> float:
    """The smallest p-value that `sign_flip` of `n` values can have: with 5 it is above 0.05 whatever they are.

    >>> least_p(5), least_p(8)
    (0.0625, 0.0078125)
    """
    return 2.0 ** (1 - n) if n <= EXACT_FLIPS else 1 / (1 + RESAMPLES)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values of one table corrected by Holm's step-down method (1979); NaN stays NaN and does not count.

    >>> holm([0.01, 0.04, 0.03])
    [0.03, 0.06, 0.06]
    """
    order = sorted((i for i, p in enumerate(p_values) if not math.isnan(p)), key=lambda i: p_values[i])
    corrected, highest = list(p_values), 0.0
    for rank, i in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * p_values[i]))
        corrected[i] = highest
    return corrected


def corrected(estimates: Sequence[Estimate]) -> list[Estimate]:
    """The estimates of one table with Holm's p-values."""
    return [replace(e, p=p) for e, p in zip(estimates, holm([e.p for e in estimates]), strict=True)]


def finite(values: Values, level: float) -> NDArray[np.float64]:
    """The values as an array.

    Raises:
        ValueError: one that is not finite, or a level outside (0, 1).
    """
    if not 0 < level < 1:
        raise ValueError(f"expected 0 < level < 1, got {level}")
    data = np.asarray(list(values), dtype=np.float64)
    if not np.isfinite(data).all():
        raise ValueError(f"expected finite values, got {list(values)}; leave failed episodes out before estimating")
    return data
