"""Designs: how large an effect could have been seen, and interactions of two module choices."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.statistics.estimates import LEVEL, Estimate, corrected, finite


def minimum_detectable_effect(deviation: float, n: int, *, power: float = 0.8, level: float = LEVEL) -> float:
    """Smallest true mean that a t test of `n` differences with standard deviation `deviation` finds with `power`.

    Solves the power of the two-sided one-sample t test (statsmodels `TTestPower`); in the unit of `deviation`.

    Raises:
        ValueError: fewer than two values, a negative deviation, or a power or level outside (0, 1).
    """
    from statsmodels.stats.power import TTestPower

    if n < 2 or deviation < 0 or not 0 < power < 1 or not 0 < level < 1:
        raise ValueError(
            f"expected n >= 2, deviation >= 0 and power and level in (0, 1); got n={n}, deviation={deviation}, "
            f"power={power}, level={level}"
        )
    effect = TTestPower().solve_power(nobs=n, alpha=1 - level, power=power, alternative="two-sided")
    return float(effect) * deviation


def interactions(
    rows: Sequence[Mapping[str, Any]],
    value: str,
    factors: tuple[str, str],
    *,
    cluster: str = "seed",
    level: float = LEVEL,
) -> dict[tuple[str, str], Estimate]:
    """How far each combination of two modules is from the sum of their effects: OLS with seed-clustered errors.

    The model is `value ~ C(first) * C(second)`; the first value met of each factor is the reference. Errors are
    clustered by task seed, with the small-sample correction and Student's t with clusters - 1 degrees of freedom. Where
    the clusters do not differ beyond float noise there is nothing to test: `p` is 1 for no interaction, else 0.

    Args:
        rows: one per episode, or per seed and combination.
        value: key of the number that is explained.
        factors: keys of the two module choices.
        cluster: key of what is shared between rows: the task seed for one checkpoint, the training run across runs.

    Returns:
        (first, second) -> interaction effect, p-values corrected by Holm over the table.

    Raises:
        ValueError: a combination without rows, fewer than two choices or clusters, or a value that is not finite.
    """
    import statsmodels.api as sm

    first, second = (list(dict.fromkeys(str(row[factor]) for row in rows)) for factor in factors)
    clusters = list(dict.fromkeys(row[cluster] for row in rows))
    present = {(str(row[factors[0]]), str(row[factors[1]])) for row in rows}
    missing = [pair for pair in itertools.product(first, second) if pair not in present]
    if len(first) < 2 or len(second) < 2 or len(clusters) < 2 or missing:
        raise ValueError(
            f"interactions of {factors[0]} ({len(first)}) and {factors[1]} ({len(second)}), {len(clusters)} clusters, "
            f"need two of each, every combination; missing: {missing or 'none'}"
        )
    pairs = list(itertools.product(first[1:], second[1:]))
    design = _design([(str(row[factors[0]]), str(row[factors[1]])) for row in rows], first, second, pairs)
    groups = np.array([clusters.index(row[cluster]) for row in rows])
    values = finite([float(row[value]) for row in rows], level)
    scale = max(1.0, float(np.abs(values).max()))
    fitted = sm.OLS(values, design).fit(cov_type="cluster", cov_kwds={"groups": groups}, use_t=True)
    bounds = fitted.conf_int(alpha=1 - level)
    start = design.shape[1] - len(pairs)
    found = []
    for j in range(start, start + len(pairs)):
        mean, (low, high), p = float(fitted.params[j]), map(float, bounds[j]), float(fitted.pvalues[j])
        if not fitted.bse[j] > 1e-7 * scale:  # clusters that agree to float noise (or below, where it is NaN)
            mean = 0.0 if abs(mean) < 1e-9 * scale else mean
            low, high, p = mean, mean, float(mean == 0)
        found.append(Estimate(mean, low, high, len(clusters), unit=cluster, p=p))
    return dict(zip(pairs, corrected(found), strict=True))


def _design(
    chosen: Sequence[tuple[str, str]], first: Sequence[str], second: Sequence[str], pairs: Sequence[tuple[str, str]]
) -> np.ndarray:
    """Columns: intercept, main effects of both factors but for their references, interactions of `pairs`."""
    columns = [*((a, "") for a in first[1:]), *(("", b) for b in second[1:]), *pairs]
    design = np.ones((len(chosen), 1 + len(columns)))
    for i, (a, b) in enumerate(chosen):
        design[i, 1:] = [float((not x or a == x) and (not y or b == y)) for x, y in columns]
    return design
