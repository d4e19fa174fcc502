"""What can be said from the numbers: intervals, tests, and how large an effect could have been seen.

Two kinds of chance must be kept apart:

- *Tasks.* One checkpoint plays many task seeds. Everything is paired by seed, and the unit is the seed's mean over
  repeats: differences per seed get a t interval and a sign-flip permutation test (`paired`). Such a statement is about
  this checkpoint only.
- *Training runs.* Another run of the same recipe gives another checkpoint. Statements about a recipe need at least
  `LEAST_RUNS` runs, and the unit is the run (`runs_mean`, `compare_runs`). Tests over task seeds alone would call the
  luck of a run an effect: with a run-to-run deviation of half an episode's, they do so in most comparisons of equal
  recipes. One run is no recipe either: only a policy that all runs have in common (the start they begin with, an
  expert) may stand against several runs as a constant.

Percentile bootstrap intervals are too narrow for few values, so they are offered from `LEAST_BOOTSTRAP` seeds on
(`bootstrap`, `interquartile_mean`). Several tests of one table are corrected by Holm's method (`holm`). The corrected
p-value decides, and not the interval, which is uncorrected and over tasks not of the same test: a difference whose
corrected p-value is above the level is a tie, and is printed as one. The simulations behind these choices are
tests (`tests/eval/test_coverage.py`).

Distributions come from SciPy, regressions from statsmodels: `pip install 'agentspec-rl[eval]'`.
"""

from __future__ import annotations

from eval.statistics.designs import interactions, minimum_detectable_effect
from eval.statistics.estimates import (
    EXACT_FLIPS,
    LEVEL,
    RESAMPLES,
    Estimate,
    corrected,
    holm,
    least_p,
    mean_interval,
    paired,
    sign_flip,
)
from eval.statistics.resampling import LEAST_BOOTSTRAP, bootstrap, interquartile_mean, performance_profile
from eval.statistics.runs import LEAST_RUNS, compare_runs, paired_runs, runs_mean, weighted_runs
from eval.statistics.transfer import Cells, Diagonal, at_home, contrasts, diagonal

__all__ = [
    "EXACT_FLIPS",
    "LEAST_BOOTSTRAP",
    "LEAST_RUNS",
    "LEVEL",
    "RESAMPLES",
    "Cells",
    "Diagonal",
    "Estimate",
    "at_home",
    "bootstrap",
    "compare_runs",
    "contrasts",
    "corrected",
    "diagonal",
    "holm",
    "interactions",
    "interquartile_mean",
    "least_p",
    "mean_interval",
    "minimum_detectable_effect",
    "paired",
    "paired_runs",
    "performance_profile",
    "runs_mean",
    "sign_flip",
    "weighted_runs",
]
