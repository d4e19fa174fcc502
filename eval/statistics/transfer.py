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
  is the share of all n! assignments whose diagonal is as far from 0. Over all of them the diagonals sum to 0: with two
  homes the other assignment's is the real one's with the other sign, so nothing can be told (NaN); with three and more
  the real one can stand alone, and the smallest p-value is 1 / n!.

`at_home` asks another question, per home: does who is trained there do better there than those trained elsewhere?
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from eval.statistics.estimates import LEVEL, RESAMPLES, Estimate
from eval.statistics.runs import weighted_runs

Cells = Mapping[str, Mapping[str, Mapping[str, Mapping[str, float]]]]
"""arm -> training run -> scaffold -> task -> value."""

EXACT_HOMES = 7
"""Up to this many homes all assignments are gone through (5,040); beyond, `RESAMPLES` random ones."""

LEAST_HOMES = 3
"""With fewer homes no assignment is further from 0 than another."""


@dataclass(frozen=True)
class Diagonal:
    """The diagonal less the rest.

    Args:
        estimate: with the p-value of the t test (of the sign-flip test, over tasks).
        permutation: p-value over assignments of homes; NaN with fewer than `LEAST_HOMES`.
        assignments: how many there are.
    """

    estimate: Estimate
    permutation: float
    assignments: int

    @property
    def tried(self) -> int:
        """How many assignments were gone through, the real one among them."""
        return self.assignments if self.assignments <= math.factorial(EXACT_HOMES) else 1 + RESAMPLES

    @property
    def least(self) -> float:
        """The smallest p-value that the permutation can have."""
        return math.nan if math.isnan(self.permutation) else 1 / self.tried


def contrasts(cells: Cells, home: Mapping[str, str]) -> dict[str, dict[str, dict[str, float]]]:
    """arm -> run -> task -> x(r), on the tasks that all cells of all homes have.

    Raises:
        ValueError: fewer than two homes, an arm without runs, or a run that was not played in one of them.
    """
    homes = _homes(cells, home)
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


def _homes(cells: Cells, home: Mapping[str, str]) -> list[str]:
    homes = list(dict.fromkeys(home[arm] for arm in cells))
    if len(homes) < 2:
        raise ValueError(f"a diagonal needs two scaffolds that policies were trained in, got {homes}")
    if empty := [arm for arm, runs in cells.items() if not runs]:
        raise ValueError(f"{empty[0]} has no run; leave it out, or train it")
    return homes


def diagonal(cells: Cells, home: Mapping[str, str], *, level: float = LEVEL, seed: int = 0) -> Diagonal:
    """Test the diagonal against the rest (see the module's text).

    Args:
        home: arm -> the scaffold it was trained in; several arms may share one, and count together once.

    Raises:
        ValueError: as `contrasts`, or no task that all cells have.
    """
    found = contrasts(cells, home)
    tasks = next(iter(next(iter(found.values())).values()))  # those that every cell has
    if not tasks:
        raise ValueError("no task was completed in every cell")
    weight, homes = _shares(found, home), _homes(cells, home)
    estimate = weighted_runs([(weight[arm], [*runs.values()]) for arm, runs in found.items()], level=level, seed=seed)
    common = {
        arm: {run: {s: {t: of[s][t] for t in tasks} for s in homes} for run, of in runs.items()}
        for arm, runs in cells.items()
    }
    return Diagonal(estimate, *_permutation(common, home, seed))


def _shares(arms: Iterable[str], home: Mapping[str, str]) -> dict[str, float]:
    """Weight of each arm in a mean over homes: homes weigh the same, and so do the arms of one."""
    sharing = [home[arm] for arm in arms]
    return {arm: 1 / (len(set(sharing)) * sharing.count(home[arm])) for arm in arms}


def _permutation(cells: Cells, home: Mapping[str, str], seed: int) -> tuple[float, int]:
    """p-value of the diagonal among all assignments of homes, and how many of those there are."""
    homes = list(dict.fromkeys(home[arm] for arm in cells))
    if len(homes) < LEAST_HOMES:
        return math.nan, math.factorial(len(homes))
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


def at_home(cells: Cells, home: Mapping[str, str], *, level: float = LEVEL, seed: int = 0) -> dict[str, Estimate]:
    """Per home: runs that were trained there less those that were trained elsewhere, both evaluated there.

    What a user who deploys in that scaffold gains by training in it, whatever the reason: how well an arm has learnt
    altogether is in it too. Every arm is a sample of its own, also where it is the only one of its side: a single run
    is a draw of its recipe and no fixed policy, so with fewer than `LEAST_RUNS` runs of any arm this is over tasks.

    Raises:
        ValueError: fewer than two homes, or an arm without runs.
    """
    found = {}
    for own in _homes(cells, home):
        here, away = ([arm for arm in cells if (home[arm] == own) == mine] for mine in (True, False))
        signed = {**_shares(here, home), **{arm: -share for arm, share in _shares(away, home).items()}}
        samples = [(weight, [of[own] for of in cells[arm].values()]) for arm, weight in signed.items()]
        found[own] = weighted_runs(samples, level=level, seed=seed)
    return found


def _mean(values: Mapping[str, float]) -> float:
    return math.fsum(values.values()) / len(values)
