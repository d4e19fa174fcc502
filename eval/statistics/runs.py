"""Training runs of a recipe: the unit of every statement about the recipe."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from eval.statistics.estimates import LEVEL, Estimate, K, Values, finite, mean_interval, paired

R = TypeVar("R", bound=Hashable)

LEAST_RUNS = 3
"""Fewest training runs that say anything about their recipe."""


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

    x, y = finite(a, level), finite(b, level)
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


def _common(runs: Sequence[Mapping[K, float]]) -> list[K]:
    return [key for key in runs[0] if all(key in run for run in runs)] if runs else []


def _mean(run: Mapping[K, float], keys: Sequence[K]) -> float:
    return math.fsum(run[key] for key in keys) / len(keys) if keys else math.nan
