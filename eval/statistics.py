"""What can be said from the numbers: intervals, tests, and how large an effect could have been seen.

Two kinds of chance must be kept apart:

- *Tasks.* One checkpoint plays many task seeds. Everything is paired by seed, and the unit is the seed's mean over
  repeats: differences per seed get a t interval and a sign-flip permutation test (`paired`). Such a statement is about
  this checkpoint only.
- *Training runs.* Another run of the same recipe gives another checkpoint. Statements about a recipe need at least
  `LEAST_RUNS` runs, and the unit is the run (`runs_mean`, `compare_runs`). Tests over task seeds alone would call the
  luck of a run an effect: with a run-to-run deviation of half an episode's, they do so in most comparisons of equal
  recipes.

Percentile bootstrap intervals are too narrow for few values, so they are offered from `LEAST_BOOTSTRAP` seeds on
(`bootstrap`, `interquartile_mean`). Several tests of one table are corrected by Holm's method (`holm`). A difference
whose corrected p-value is above the level is a tie, and is printed as one. The simulations behind these choices are
tests (`tests/eval/test_coverage.py`).

Distributions come from SciPy, regressions from statsmodels: `pip install 'agentspec-rl[eval]'`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

K = TypeVar("K", bound=Hashable)
R = TypeVar("R", bound=Hashable)
Values = Sequence[float]

LEVEL = 0.95
LEAST_RUNS = 3
"""Fewest training runs that say anything about their recipe."""
LEAST_BOOTSTRAP = 32
"""Fewest values for a percentile bootstrap (with 8 it covers 86 % where 95 % is claimed)."""
RESAMPLES = 10_000
EXACT_FLIPS = 14
"""Up to this many values the sign-flip test goes through all flips (16,384); beyond, through `RESAMPLES` random
ones."""


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
        """Whether no difference was shown at `level`: the p-value where there is one, else the interval, decides."""
        if not math.isnan(self.p):
            return self.p > 1 - level
        return math.isnan(self.low) or self.low <= 0 <= self.high

    def to_data(self) -> dict[str, Any]:
        """JSON values: NaN becomes `None`."""
        numbers = {"mean": self.mean, "low": self.low, "high": self.high, "p": self.p}
        clean = {name: None if math.isnan(value) else value for name, value in numbers.items()}
        return {**clean, "n": self.n, "unit": self.unit, "note": self.note}


# -- means and paired differences over task seeds --------------------------------------------------


def mean_interval(values: Values, *, level: float = LEVEL, unit: str = "seed") -> Estimate:
    """Mean and Student's t interval; one value has no interval.

    >>> estimate = mean_interval([1.0, 2.0, 3.0])
    >>> round(estimate.low, 3), round(estimate.high, 3)
    (-0.484, 4.484)

    Raises:
        ValueError: a level outside (0, 1), or a value that is not finite.
    """
    from scipy import stats

    data = _finite(values, level)
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
    differences = [a[key] - b[key] for key in a if key in b]
    estimate = mean_interval(differences, level=level)
    return replace(estimate, p=sign_flip(differences, seed=seed), note="this checkpoint only")


def sign_flip(values: Values, *, seed: int = 0) -> float:
    """Two-sided p-value of "the values are symmetric about 0": the share of sign flips with a mean at least as far
    from 0.

    Exact up to `EXACT_FLIPS` values; beyond, Monte Carlo with the observed signs counted among the flips.

    >>> sign_flip([1.0, 2.0, 3.0])  # of 8 flips, all plus and all minus are as far as observed
    0.25
    """
    data = _finite(values, LEVEL)
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


def bootstrap(values: Values, *, level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0) -> Estimate:
    """Mean and percentile bootstrap interval (Efron, 1979), for values too skewed for a t interval.

    Raises:
        ValueError: fewer than `LEAST_BOOTSTRAP` values, or as `mean_interval`.
    """
    data = _finite(values, level)
    _enough(data.size)
    drawn = _resampled(data, resamples, seed)
    low, high = np.quantile(drawn.mean(axis=1), [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(data.mean()), float(low), float(high), data.size)


def interquartile_mean(values: Values, *, level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0) -> Estimate:
    """Mean of the middle half and its percentile bootstrap interval (Agarwal et al., 2021).

    Raises:
        ValueError: fewer than `LEAST_BOOTSTRAP` values, or as `mean_interval`.
    """
    from scipy import stats

    data = _finite(values, level)
    _enough(data.size)
    drawn = stats.trim_mean(_resampled(data, resamples, seed), 0.25, axis=1)
    low, high = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(stats.trim_mean(data, 0.25)), float(low), float(high), data.size)


def performance_profile(values: Values, thresholds: Values) -> list[float]:
    """Share of `values` above each threshold (Dolan and More, 2002; Agarwal et al., 2021); NaN of no values.

    Raises:
        ValueError: a value that is not finite.
    """
    data = _finite(values, LEVEL)
    return [float(np.mean(data > threshold)) if data.size else math.nan for threshold in thresholds]


# -- training runs ---------------------------------------------------------------------------------


def runs_mean(runs: Sequence[Mapping[K, float]], *, level: float = LEVEL) -> Estimate:
    """Mean over training runs of one recipe, each run's value being its mean over the task seeds that all runs have.

    The interval is Student's over the runs. With fewer than `LEAST_RUNS` runs it is the interval over seeds of the
    runs' mean, and the note says `this checkpoint only`.
    """
    common = _common(runs)
    if len(runs) >= LEAST_RUNS and not common:
        return Estimate(math.nan, math.nan, math.nan, 0, "run", note="no task that all runs have")
    if len(runs) < LEAST_RUNS:
        seeds = [math.fsum(run[key] for run in runs) / len(runs) for key in common] if runs else []
        return replace(mean_interval(seeds, level=level), note="this checkpoint only")
    return mean_interval([_mean(run, common) for run in runs], level=level, unit="run")


def compare_runs(
    a: Sequence[Mapping[K, float]], b: Sequence[Mapping[K, float]], *, level: float = LEVEL, seed: int = 0
) -> Estimate:
    """Difference of two recipes' means over their training runs, on the task seeds that all runs have.

    With `LEAST_RUNS` runs on both sides: Welch's t interval and test over runs. If one side is a fixed policy that was
    not trained (a start, an expert), pass it as one run: the unit is then the run of the other side, one sample.
    Otherwise the runs at hand are compared over seeds, and the note says `this checkpoint only`.
    """
    if len(a) == 1 and len(b) >= LEAST_RUNS:
        turned = compare_runs(b, a, level=level, seed=seed)
        return replace(turned, mean=-turned.mean, low=-turned.high, high=-turned.low)
    if not a or not b:
        return Estimate(math.nan, math.nan, math.nan, 0, note="one side has no run with a value")
    common = _common([*a, *b])
    if len(a) >= LEAST_RUNS and (len(b) == 1 or len(b) >= LEAST_RUNS):
        if not common:
            return Estimate(math.nan, math.nan, math.nan, 0, "run")
        return _welch([_mean(run, common) for run in a], [_mean(run, common) for run in b], level)
    sides = [{key: math.fsum(run[key] for run in side) / max(1, len(side)) for key in common} for side in (a, b)]
    return paired(*sides, level=level, seed=seed)


def paired_runs(
    a: Mapping[R, Mapping[K, float]], b: Mapping[R, Mapping[K, float]], *, level: float = LEVEL, seed: int = 0
) -> Estimate:
    """Mean of `a - b` where both are played by the same training runs (one policy in two scaffolds).

    With `LEAST_RUNS` runs on both sides each run gives one difference (over its task seeds): a t interval over the
    runs and its test. With fewer the runs at hand are compared over seeds, and the note says so.
    """
    both = [run for run in a if run in b]
    common = _common([side[run] for run in both for side in (a, b)])
    if len(both) >= LEAST_RUNS:
        if not common:
            return Estimate(math.nan, math.nan, math.nan, 0, "run")
        return _welch([_mean(a[run], common) - _mean(b[run], common) for run in both], [0.0], level)
    sides = [{key: math.fsum(side[run][key] for run in both) / max(1, len(both)) for key in common} for side in (a, b)]
    return paired(*sides, level=level, seed=seed)


def _welch(a: Values, b: Values, level: float) -> Estimate:
    """Welch's unequal-variances t interval and test of the difference of two means; a lone `b` is taken as exact.

    Where no side varies beyond float noise there is nothing to test: `p` is 1 for equal means, else 0.
    """
    from scipy import stats

    x, y = _finite(a, level), _finite(b, level)
    noise = 1e-12 * max(1.0, float(np.abs([*x, *y]).max()))
    mean = float(x.mean() - y.mean())
    if np.ptp(x) <= noise and np.ptp(y) <= noise:
        return Estimate(mean, mean, mean, min(n for n in (x.size, y.size) if n > 1), "run", float(abs(mean) <= noise))
    if y.size == 1:
        estimate = mean_interval([float(gain) for gain in x - y], level=level, unit="run")
        return replace(estimate, p=float(stats.ttest_1samp(x - y, 0.0).pvalue))
    found = stats.ttest_ind(x, y, equal_var=False)
    interval = found.confidence_interval(confidence_level=level)
    return Estimate(mean, float(interval.low), float(interval.high), min(x.size, y.size), "run", float(found.pvalue))


# -- tables, designs and interactions --------------------------------------------------------------


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
    columns = [
        *(("main", a, "") for a in first[1:]),
        *(("main", "", b) for b in second[1:]),
        *(("both", a, b) for a, b in pairs),
    ]
    design = np.ones((len(rows), 1 + len(columns)))
    for i, row in enumerate(rows):
        a, b = str(row[factors[0]]), str(row[factors[1]])
        for j, (_, x, y) in enumerate(columns, start=1):
            design[i, j] = float((not x or a == x) and (not y or b == y))
    groups = np.array([clusters.index(row[cluster]) for row in rows])
    values = _finite([float(row[value]) for row in rows], level)
    scale = max(1.0, float(np.abs(values).max()))
    fitted = sm.OLS(values, design).fit(cov_type="cluster", cov_kwds={"groups": groups}, use_t=True)
    bounds = fitted.conf_int(alpha=1 - level)
    start = 1 + len(columns) - len(pairs)
    found = []
    for j in range(start, start + len(pairs)):
        mean, (low, high), p = float(fitted.params[j]), map(float, bounds[j]), float(fitted.pvalues[j])
        if not fitted.bse[j] > 1e-7 * scale:  # clusters that agree to float noise (or below, where it is NaN)
            mean = 0.0 if abs(mean) < 1e-9 * scale else mean
            low, high, p = mean, mean, float(mean == 0)
        found.append(Estimate(mean, low, high, len(clusters), unit=cluster, p=p))
    return dict(zip(pairs, corrected(found), strict=True))


# -- helpers ---------------------------------------------------------------------------------------


def _finite(values: Values, level: float) -> NDArray[np.float64]:
    if not 0 < level < 1:
        raise ValueError(f"expected 0 < level < 1, got {level}")
    data = np.asarray(list(values), dtype=np.float64)
    if not np.isfinite(data).all():
        raise ValueError(f"expected finite values, got {list(values)}; leave failed episodes out before estimating")
    return data


def _enough(n: int) -> None:
    if n < LEAST_BOOTSTRAP:
        raise ValueError(
            f"a percentile bootstrap of {n} values would be too narrow; it needs {LEAST_BOOTSTRAP}, use mean_interval"
        )


def _resampled(data: NDArray[np.float64], resamples: int, seed: int) -> NDArray[np.float64]:
    """Bootstrap samples, shape (resamples, n)."""
    if resamples < 1:
        raise ValueError(f"expected at least one resample, got {resamples}")
    return data[np.random.default_rng(seed).integers(0, data.size, size=(resamples, data.size))]


def _common(runs: Sequence[Mapping[K, float]]) -> list[K]:
    return [key for key in runs[0] if all(key in run for run in runs)] if runs else []


def _mean(run: Mapping[K, float], keys: Sequence[K]) -> float:
    return math.fsum(run[key] for key in keys) / len(keys) if keys else math.nan
