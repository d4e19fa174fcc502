"""Is it worth training where one deploys? The diagonal of the matrix "trained in x evaluated in" against the rest.

Let `v(r, s)` be what training run `r` earns in scaffold `s` (its mean over the tasks that all cells have), and let the
scaffolds be those that somebody was trained in, its *homes*. A run's contrast is

    x(r) = v(r, home of r) - mean of v(r, s) over the other homes s.

It holds how hard the scaffolds are: an easy home makes it large whoever was trained there. In the mean over all homes
that cancels, since every home is once the own one and equally often among the others, and so does how well a run has
learnt altogether. What is left is the diagonal's: 0 if no policy is better at home than elsewhere. `diagonal` tests it

- over training runs: the runs of an arm are a sample of its own (their variances need not be equal), and the interval
  is Student's with Satterthwaite's degrees of freedom. With fewer than `LEAST_RUNS` runs of any arm it is over tasks,
  about these checkpoints only;
- by permutation: if homes mean nothing, any assignment of homes to the policies is as good as the real one. The p-value
  is the share of all n! assignments whose diagonal is as far from 0; with three homes it cannot be below 1/6.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from eval.statistics import LEAST_RUNS, LEVEL, RESAMPLES, Estimate, compare_runs, mean_interval, sign_flip

Cells = Mapping[str, Mapping[str, Mapping[str, Mapping[str, float]]]]
"""arm -> training run -> scaffold -> task -> value."""

EXACT_HOMES = 7
"""Up to this many homes all assignments are gone through (5,040); beyond, `RESAMPLES` random ones."""


@dataclass(frozen=True)
class Diagonal:
    """The diagonal less the rest.

    Args:
        estimate: with the p-value of the t test (of the sign-flip test, over tasks).
        permutation: p-value over assignments of homes; NaN with one home.
        assignments: how many there are.
    """

    estimate: Estimate
    permutation: float
    assignments: int


def contrasts(cells: Cells, home: Mapping[str, str]) -> dict[str, dict[str, dict[str, float]]]:
    """arm -> run -> task -> x(r), on the tasks that all cells of all homes have.

    Raises:
        ValueError: fewer than two homes, or a run that was not played in one of them.
    """
    homes = list(dict.fromkeys(home[arm] for arm in cells))
    if len(homes) < 2:
        raise ValueError(f"a diagonal needs two scaffolds that policies were trained in, got {homes}")
    for arm, runs in cells.items():
        if lacking := [(run, s) for run, of in runs.items() for s in homes if not of.get(s)]:
            raise ValueError(f"run {lacking[0][0]} of {arm} has no value in {lacking[0][1]}; evaluate it there")
    played = [of[s] for runs in cells.values() for of in runs.values() for s in homes]
    tasks = [task for task in played[0] if all(task in values for values in played)]
    found: dict[str, dict[str, dict[str, float]]] = {}
    for arm, runs in cells.items():
        others = [s for s in homes if s != home[arm]]
        found[arm] = {
            run: {t: of[home[arm]][t] - math.fsum(of[s][t] for s in others) / len(others) for t in tasks}
            for run, of in runs.items()
        }
    return found


def diagonal(cells: Cells, home: Mapping[str, str], *, level: float = LEVEL, seed: int = 0) -> Diagonal:
    """Test the diagonal against the rest (see the module's text).

    Args:
        home: arm -> the scaffold it was trained in; several arms may share one, and count together once.

    Raises:
        ValueError: as `contrasts`, or no task that all cells have.
    """
    found = contrasts(cells, home)
    if not all(values for runs in found.values() for values in runs.values()):
        raise ValueError("no task was completed in every cell")
    sharing = [home[arm] for arm in found]
    weight = {arm: 1 / (len(set(sharing)) * sharing.count(home[arm])) for arm in found}
    means = {arm: [math.fsum(v.values()) / len(v) for v in runs.values()] for arm, runs in found.items()}
    if min(map(len, means.values())) < LEAST_RUNS:
        tasks = next(iter(next(iter(found.values())).values()))
        by_task = [
            math.fsum(weight[arm] * math.fsum(v[t] for v in runs.values()) / len(runs) for arm, runs in found.items())
            for t in tasks
        ]
        over = mean_interval(by_task, level=level)
        p = sign_flip(by_task, seed=seed)
        estimate = Estimate(over.mean, over.low, over.high, over.n, "seed", p, "this checkpoint only")
    else:
        estimate = _stratified([(weight[arm], values) for arm, values in means.items()], level)
    tasks = next(iter(next(iter(found.values())).values()))  # those that every cell has
    common = {
        arm: {run: {s: {t: of[s][t] for t in tasks} for s in sharing} for run, of in cells[arm].items()}
        for arm in found
    }
    return Diagonal(estimate, *_permutation(common, home, seed))


def _stratified(samples: Sequence[tuple[float, Sequence[float]]], level: float) -> Estimate:
    """A weighted sum of the means of independent samples: t interval and test with Satterthwaite's degrees of freedom.

    Where no sample varies beyond float noise there is nothing to test: `p` is 1 for 0, else 0.
    """
    from scipy import stats

    mean = math.fsum(w * math.fsum(values) / len(values) for w, values in samples)
    count = sum(len(values) for _, values in samples)
    parts = [w**2 * float(np.var(values, ddof=1)) / len(values) for w, values in samples]
    noise = 1e-12 * max(1.0, *(abs(v) for _, values in samples for v in values))
    if (error := math.sqrt(math.fsum(parts))) <= noise:
        return Estimate(mean, mean, mean, count, "run", float(abs(mean) <= noise))
    freedom = math.fsum(parts) ** 2 / math.fsum(
        part**2 / (len(values) - 1) for part, (_, values) in zip(parts, samples, strict=True)
    )
    half = float(stats.t.ppf((1 + level) / 2, freedom)) * error
    p = float(2 * stats.t.sf(abs(mean) / error, freedom))
    return Estimate(mean, mean - half, mean + half, count, "run", p)


def _permutation(cells: Cells, home: Mapping[str, str], seed: int) -> tuple[float, int]:
    """p-value of the diagonal among all assignments of homes, and how many of those there are."""
    homes = list(dict.fromkeys(home[arm] for arm in cells))
    grid = np.zeros((len(homes), len(homes)))
    for i, own in enumerate(homes):
        arms = [arm for arm in cells if home[arm] == own]
        for j, other in enumerate(homes):
            runs = [[_mean(of[other]) for of in cells[arm].values()] for arm in arms]
            grid[i, j] = math.fsum(math.fsum(values) / len(values) for values in runs) / len(arms)
    n = len(homes)
    places, rng = range(n), random.Random(seed)
    ways = (
        list(itertools.permutations(places))
        if n <= EXACT_HOMES
        else [tuple(places), *(tuple(rng.sample(places, n)) for _ in range(RESAMPLES))]
    )
    rows = grid - grid.mean(axis=1, keepdims=True)
    drawn = np.array([rows[places, way].sum() for way in ways])
    slack = 1e-12 * max(1.0, float(np.abs(grid).max()))
    return float(np.mean(np.abs(drawn) >= abs(drawn[0]) - slack)), math.factorial(n)


def at_home(cells: Cells, home: Mapping[str, str], *, level: float = LEVEL) -> dict[str, Estimate]:
    """Per home: runs that were trained there less all runs that were trained elsewhere, both evaluated there.

    What a user who deploys in that scaffold gains by training in it, whatever the reason: how well an arm has learnt
    altogether is in it too.
    """
    found = {}
    for own in dict.fromkeys(home[arm] for arm in cells):
        here, away = (
            [of[own] for arm, runs in cells.items() if (home[arm] == own) == mine for of in runs.values()]
            for mine in (True, False)
        )
        found[own] = compare_runs(here, away, level=level)
    return found


def _mean(values: Mapping[str, float]) -> float:
    return math.fsum(values.values()) / len(values)
