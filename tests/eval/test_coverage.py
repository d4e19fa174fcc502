"""Intervals cover, and tests err, as often as they say: a thousand simulated experiments each.

Episodes are simulated as the benchmarks have them: a day that all policies share (paired by seed), noise of the
episode, and a deviation from training run to training run. Coverage of 95 % intervals must lie in [93, 97] %, false
positives of tests at 5 % in [3, 7] %: with 1,000 simulations the standard error is 0.7 %.
"""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("scipy", reason="needs the extra eval")
pytest.importorskip("statsmodels", reason="needs the extra eval")

from scipy import stats

from eval import statistics

pytestmark = pytest.mark.slow
SIMULATIONS = 1000


def episodes(rng, seeds, *, effect=0.0, run=0.0):
    """Values by seed of two policies; `run` is the deviation between training runs of each."""
    day, noise = rng.normal(0, 3, seeds), rng.normal(0, 1, (2, seeds))
    mine = day + noise[0] + effect + run * rng.normal()
    theirs = day + noise[1] + run * rng.normal()
    return dict(enumerate(mine)), dict(enumerate(theirs))


def share(outcomes) -> float:
    return float(np.mean(list(outcomes)))


@pytest.mark.parametrize("n", [8, 16, 32])
def test_t_intervals_over_seeds_cover(n):
    rng = np.random.default_rng(n)
    found = [statistics.mean_interval(rng.normal(1, 2, n)) for _ in range(SIMULATIONS)]
    assert 0.93 <= share(e.low <= 1 <= e.high for e in found) <= 0.97


@pytest.mark.parametrize("n", [8, 16, 32])
def test_paired_intervals_cover_and_sign_flips_err_as_they_say(n):
    rng = np.random.default_rng(n + 1)
    found = [statistics.paired(*episodes(rng, n)) for _ in range(SIMULATIONS)]
    assert 0.93 <= share(e.low <= 0 <= e.high for e in found) <= 0.97
    assert 0.03 <= share(e.p <= 0.05 for e in found) <= 0.07


@pytest.mark.parametrize("n", [32, 64])
def test_bootstrap_intervals_cover_from_32_values_on(n):
    rng = np.random.default_rng(n)
    found = [statistics.bootstrap(rng.normal(1, 2, n), resamples=2000, seed=i) for i in range(SIMULATIONS)]
    assert 0.93 <= share(e.low <= 1 <= e.high for e in found) <= 0.97


def test_bootstrap_of_eight_values_would_not():
    """Why it is refused: the same procedure at n = 8, with SciPy's own percentile bootstrap."""
    rng = np.random.default_rng(0)
    covered = []
    for i in range(SIMULATIONS):
        data = (rng.normal(1, 2, 8),)
        interval = stats.bootstrap(data, np.mean, n_resamples=500, method="percentile", rng=i).confidence_interval
        covered.append(interval.low <= 1 <= interval.high)
    assert share(covered) < 0.92


@pytest.mark.parametrize("n", [32, 64])
def test_interquartile_means_cover(n):
    rng = np.random.default_rng(n)
    found = [statistics.interquartile_mean(rng.normal(1, 2, n), resamples=1000, seed=i) for i in range(SIMULATIONS)]
    assert 0.93 <= share(e.low <= 1 <= e.high for e in found) <= 0.97


@pytest.mark.parametrize("runs", [3, 5, 8])
def test_recipes_are_compared_over_runs(runs):
    rng = np.random.default_rng(runs)
    found = []
    for _ in range(SIMULATIONS):
        day = rng.normal(0, 3, 16)
        sides = [
            [dict(enumerate(day + rng.normal(0, 1, 16) + 0.5 * rng.normal())) for _ in range(runs)] for _ in range(2)
        ]
        found.append(statistics.compare_runs(*sides))
    assert 0.93 <= share(e.low <= 0 <= e.high for e in found) <= 0.98  # Welch is a little wide for three runs
    assert 0.02 <= share(e.p <= 0.05 for e in found) <= 0.07


def trained(rng, tasks, arms, runs, scaffolds):
    """arm -> run -> scaffold -> task -> value of equal recipes: a task's difficulty, the run's luck, the episode's."""
    day = rng.normal(0, 3, (scaffolds, tasks))
    return {
        a: {
            r: {s: dict(enumerate(day[s] + luck + rng.normal(0, 1, tasks))) for s in range(scaffolds)}
            for r in range(runs)
            for luck in [0.5 * rng.normal()]
        }
        for a in range(arms)
    }


@pytest.mark.parametrize("runs", [3, 5])
def test_runs_against_the_start_they_begin_with_err_as_they_say(runs):
    """The start is a constant of all runs. Another recipe's only run is not: so treated it errs far more often."""
    rng = np.random.default_rng(runs)
    constant, drawn = [], []
    for _ in range(SIMULATIONS):
        day = rng.normal(0, 3, 16)
        start = dict(enumerate(day + rng.normal(0, 1, 16)))
        arm = [{t: v + 0.5 * luck + noise[t] for t, v in start.items()} for luck in rng.normal(0, 1, runs)
               for noise in [rng.normal(0, 1, 16)]]  # fmt: skip
        constant.append(statistics.compare_runs(arm, [start], fixed=True))
        lone, *others = trained(rng, 16, 1, 1 + runs, 1)[0].values()
        sides = [run[0] for run in others], [lone[0]]
        drawn.append(statistics.compare_runs(*sides, fixed=True))
    assert 0.03 <= share(e.p <= 0.05 for e in constant) <= 0.07
    assert 0.93 <= share(e.low <= 0 <= e.high for e in constant) <= 0.97
    assert share(e.p <= 0.05 for e in drawn) > 0.15
    assert statistics.compare_runs(*sides).note == "this checkpoint only"


@pytest.mark.parametrize("runs", [3, 5])
def test_the_diagonal_and_who_was_trained_at_home_err_as_they_say(runs):
    rng = np.random.default_rng(runs + 10)
    diagonals, own, permuted = [], [], []
    homes = dict(enumerate(range(4)))
    for _ in range(SIMULATIONS):
        cells = trained(rng, 16, 4, runs, 4)
        found = statistics.diagonal(cells, homes)
        diagonals.append(found.estimate)
        permuted.append(found.permutation)
        own.append(statistics.at_home(cells, homes)[0])
    for found in (diagonals, own):
        assert 0.03 <= share(e.p <= 0.05 for e in found) <= 0.07
        assert 0.93 <= share(e.low <= 0 <= e.high for e in found) <= 0.97
    assert 0.02 <= share(p <= 0.05 for p in permuted) <= 0.07


def test_seeds_alone_would_call_luck_between_runs_an_effect():
    """Why runs are the unit: one run of each of two equal recipes, run deviation half of an episode's, 32 seeds."""
    rng = np.random.default_rng(0)
    day_sd = 1.0
    found = []
    for _ in range(SIMULATIONS):
        noise = rng.normal(0, day_sd, (2, 32))
        mine, theirs = (noise[i] + 0.5 * day_sd * rng.normal() for i in range(2))
        found.append(statistics.paired(dict(enumerate(mine)), dict(enumerate(theirs))))
    assert share(e.p <= 0.05 for e in found) > 0.4
    assert all(e.note == "this checkpoint only" for e in found)


@pytest.mark.parametrize("runs", [3, 5])
def test_means_over_runs_cover(runs):
    rng = np.random.default_rng(runs)
    found = []
    for _ in range(SIMULATIONS):
        sample = [dict(enumerate(1.0 + rng.normal(0, 1, 16) + 0.5 * rng.normal())) for _ in range(runs)]
        found.append(statistics.runs_mean(sample))
    assert 0.93 <= share(e.low <= 1 <= e.high for e in found) <= 0.97


def test_holm_keeps_the_error_of_a_table():
    rng = np.random.default_rng(0)
    wrong = []
    for _ in range(SIMULATIONS):
        table = statistics.corrected([statistics.paired(*episodes(rng, 12)) for _ in range(6)])
        wrong.append(any(not e.tie() for e in table))
    assert share(wrong) <= 0.07


@pytest.mark.parametrize("seeds", [16, 32])
def test_interactions_cover_and_err_as_they_say(seeds):
    rng = np.random.default_rng(seeds)
    found = []
    for _ in range(SIMULATIONS):
        day = rng.normal(0, 3, seeds)
        rows = [
            {"a": a, "b": b, "seed": s, "y": a + 2 * b + day[s] + rng.normal()}
            for a in (0, 1)
            for b in (0, 1)
            for s in range(seeds)
        ]
        found.append(statistics.interactions(rows, "y", ("a", "b"))["1", "1"])
    assert 0.93 <= share(e.low <= 0 <= e.high for e in found) <= 0.97
    assert 0.03 <= share(e.p <= 0.05 for e in found) <= 0.07
