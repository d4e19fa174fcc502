"""Training runs of a recipe: the unit of every statement about the recipe."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from eval.statistics.estimates import LEVEL, THESE, Estimate, K, Values, finite, mean_interval, over_tasks

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
        return replace(mean_interval(seeds, level=level), note=THESE)
    return mean_interval([_mean(run, common) for run in runs], level=level, unit="run")


def compare_runs(
    a: Sequence[Mapping[K, float]],
    b: Sequence[Mapping[K, float]],
    *,
    fixed: bool = False,
    level: float = LEVEL,
    seed: int = 0,
) -> Estimate:
    """Difference of two recipes' means over their training runs, on the task seeds that all runs have.

    With `LEAST_RUNS` runs on both sides: Welch's t interval and test over runs. Otherwise the runs at hand are compared
    over seeds, and the note says `this checkpoint only`.

    Args:
        fixed: a side of one run is no draw of a recipe but the same policy for every run of the other side: the start
            they begin with, an expert. The unit is then the run of the other side, one sample. (Where it is a draw,
            its own luck is in no run's deviation: 24 % of such tests find a difference of equal recipes.)
    """
    if fixed and min(len(a), len(b)) == 1:
        gains = [{key: x[key] - y[key] for key in x if key in y} for x in a for y in b]
        return weighted_runs([(1.0, gains)], level=level, seed=seed)
    found = weighted_runs([(1.0, a), (-1.0, b)], level=level, seed=seed)
    return replace(found, n=min(len(a), len(b))) if found.unit == "run" and found.n else found


def paired_runs(
    a: Mapping[R, Mapping[K, float]], b: Mapping[R, Mapping[K, float]], *, level: float = LEVEL, seed: int = 0
) -> Estimate:
    """Mean of `a - b` where both are played by the same training runs (one policy in two scaffolds).

    With `LEAST_RUNS` runs on both sides each run gives one difference (over its task seeds): a t interval over the
    runs and its test. With fewer the runs at hand are compared over seeds, and the note says so.
    """
    both = [{key: a[run][key] - b[run][key] for key in a[run] if key in b[run]} for run in a if run in b]
    return weighted_runs([(1.0, both)], level=level, seed=seed)


def weighted_runs(
    samples: Sequence[tuple[float, Sequence[Mapping[K, float]]]], *, level: float = LEVEL, seed: int = 0
) -> Estimate:
    """A weighted sum of recipes' means over their training runs, on the task seeds that all runs have.

    With `LEAST_RUNS` runs of each: the runs of a recipe are an independent sample with a variance of its own; t
    interval and test with Satterthwaite's degrees of freedom (of two samples Welch's, of one Student's). Otherwise over
    seeds, and the note says `this checkpoint only`; so too where runs do not differ at all: a few runs with the same
    share of tasks passed are chance, and say nothing of how runs vary.

    Args:
        samples: weight and runs of each recipe.
    """
    if not all(runs for _, runs in samples):
        return Estimate(math.nan, math.nan, math.nan, 0, note="one side has no run with a value")
    common = _common([run for _, runs in samples for run in runs])
    if min(len(runs) for _, runs in samples) >= LEAST_RUNS:
        if not common:
            return Estimate(math.nan, math.nan, math.nan, 0, "run", note="no task that all runs have")
        found = _satterthwaite([(weight, [_mean(run, common) for run in runs]) for weight, runs in samples], level)
        if found is not None:
            return found
    means = [(weight, {k: math.fsum(run[k] for run in runs) / len(runs) for k in common}) for weight, runs in samples]
    return over_tasks([math.fsum(weight * of[key] for weight, of in means) for key in common], level=level, seed=seed)


def _satterthwaite(samples: Sequence[tuple[float, Values]], level: float) -> Estimate | None:
    """A weighted sum of the means of independent samples; `None` where it is not 0 and no sample varies."""
    from scipy import stats

    weighted = [(weight, finite(values, level)) for weight, values in samples]
    mean = math.fsum(weight * float(x.mean()) for weight, x in weighted)
    count = sum(x.size for _, x in weighted)
    noise = 1e-12 * max(1.0, *(float(np.abs(x).max()) for _, x in weighted))
    if all(np.ptp(x) <= noise for _, x in weighted):
        return Estimate(mean, mean, mean, count, "run", 1.0) if abs(mean) <= noise else None
    parts = [weight**2 * float(x.var(ddof=1)) / x.size for weight, x in weighted]
    freedom = sum(parts) ** 2 / sum(part**2 / (x.size - 1) for part, (_, x) in zip(parts, weighted, strict=True))
    error = math.sqrt(sum(parts))
    half = float(stats.t.ppf((1 + level) / 2, freedom)) * error
    return Estimate(mean, mean - half, mean + half, count, "run", float(2 * stats.t.sf(abs(mean) / error, freedom)))


def _common(runs: Sequence[Mapping[K, float]]) -> list[K]:
    return [key for key in runs[0] if all(key in run for run in runs)] if runs else []


def _mean(run: Mapping[K, float], keys: Sequence[K]) -> float:
    return math.fsum(run[key] for key in keys) / len(keys) if keys else math.nan
