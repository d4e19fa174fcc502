"""Intervals whose exact values are known."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.statistics import Estimate, bootstrap, crossed_bootstrap, paired_difference


def test_two_values() -> None:
    # Means of two draws from {0, 1}: 0 with probability 1/4, 0.5 with 1/2, 1 with 1/4. The 2.5 % and 97.5 % quantiles
    # are therefore 0 and 1, the 30 % and 70 % quantiles (an interval of 40 %) both 0.5.
    assert bootstrap([0.0, 1.0]) == Estimate(0.5, 0.0, 1.0, 2)
    assert bootstrap([0.0, 1.0], level=0.4) == Estimate(0.5, 0.5, 0.5, 2)


def test_constant_values_have_a_point_as_interval() -> None:
    assert bootstrap([2.5] * 7) == Estimate(2.5, 2.5, 2.5, 7)


def test_the_interval_approaches_the_normal_one() -> None:
    # 200 zeros and 200 ones: the standard error of the mean is 0.5 / sqrt(400) = 0.025, so 95 % is 0.5 -+ 0.049.
    estimate = bootstrap([0.0, 1.0] * 200)
    assert estimate.low == pytest.approx(0.451, abs=0.004)
    assert estimate.high == pytest.approx(0.549, abs=0.004)


def test_the_seed_fixes_the_interval() -> None:
    values = [0.3, 1.7, -2.0, 5.0, 0.0]
    whole = bootstrap(values, seed=3)
    assert bootstrap(values, seed=3) == whole
    assert bootstrap(values, seed=4) != whole


def test_too_few_values_have_no_interval() -> None:
    one, none = bootstrap([4.0]), bootstrap([])
    assert (one.mean, one.n) == (4.0, 1) and math.isnan(one.low) and math.isnan(one.high)
    assert math.isnan(none.mean) and none.n == 0
    assert one.to_data() == {"mean": 4.0, "low": None, "high": None, "n": 1}


def test_pairing_removes_what_tasks_share() -> None:
    # Tasks differ by hundreds, policies by exactly 2: the difference is certain although the means overlap widely.
    b = {"easy": 900.0, "hard": 10.0, "fair": 300.0, "only b": 5.0}
    a = {"easy": 902.0, "hard": 12.0, "fair": 302.0, "only a": 1.0}
    assert paired_difference(a, b) == Estimate(2.0, 2.0, 2.0, 3)


def test_refusals() -> None:
    with pytest.raises(ValueError, match="level"):
        bootstrap([1.0], level=1.0)
    with pytest.raises(ValueError, match="resamples"):
        bootstrap([1.0], resamples=0)
    with pytest.raises(ValueError, match="finite"):
        bootstrap([1.0, math.nan])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=20))
def test_the_interval_lies_within_the_values(values: list[float]) -> None:
    estimate = bootstrap(values, resamples=200)
    assert min(values) - 1e-9 <= estimate.low <= estimate.high <= max(values) + 1e-9


def test_crossed_bootstrap_covers_runs_and_tasks() -> None:
    same = crossed_bootstrap([[1.0, 3.0, 5.0, 7.0]] * 3)
    tasks_only = bootstrap([1.0, 3.0, 5.0, 7.0])
    assert same.mean == tasks_only.mean == 4.0
    assert same.low == pytest.approx(tasks_only.low, abs=0.5) and same.high == pytest.approx(tasks_only.high, abs=0.5)
    # Runs that differ widen it, though the tasks agree: their mean alone has no spread over tasks.
    runs = crossed_bootstrap([[0.0] * 4, [10.0] * 4])
    assert (runs.mean, runs.low, runs.high) == (5.0, 0.0, 10.0)
    assert bootstrap([5.0] * 4).low == 5.0
    one = crossed_bootstrap([[1.0, 3.0, 5.0, 7.0]])
    assert one == tasks_only
    with pytest.raises(ValueError, match="same tasks for every run"):
        crossed_bootstrap([[1.0], [1.0, 2.0]])
