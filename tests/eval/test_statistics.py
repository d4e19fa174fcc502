"""Intervals and tests whose exact values are known, or are SciPy's and statsmodels'."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

pytest.importorskip("scipy", reason="needs the extra eval")
pytest.importorskip("statsmodels", reason="needs the extra eval")

from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from eval.statistics import (
    Estimate,
    bootstrap,
    compare_runs,
    corrected,
    holm,
    interactions,
    interquartile_mean,
    least_p,
    mean_interval,
    minimum_detectable_effect,
    paired,
    performance_profile,
    runs_mean,
    sign_flip,
    weighted_runs,
)

some = st.lists(st.floats(-100, 100), min_size=2, max_size=9)


def test_t_interval_of_three_values():
    # mean 2, s = 1, t(2, .975) = 4.3027: 2 -+ 4.3027 / sqrt 3 = 2 -+ 2.4841
    estimate = mean_interval([1.0, 2.0, 3.0])
    assert (estimate.mean, estimate.n, estimate.unit) == (2.0, 3, "seed")
    assert (estimate.low, estimate.high) == pytest.approx((-0.4841, 4.4841), abs=1e-4)


@settings(deadline=None)
@given(some)
def test_t_interval_is_scipys(values):
    low, high = stats.t.interval(0.9, len(values) - 1, np.mean(values), stats.sem(values))
    estimate = mean_interval(values, level=0.9)
    if np.std(values) > 1e-9:
        assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-8)


def test_too_few_values_have_no_interval_and_no_verdict():
    one, none = mean_interval([4.0]), mean_interval([])
    assert one.mean == 4.0 and math.isnan(one.low) and one.tie()
    assert math.isnan(none.mean) and none.to_data() == {
        **dict.fromkeys(("mean", "low", "high", "p")), "n": 0, "unit": "seed", "note": "",
    }  # fmt: skip


def test_sign_flip_counts_flips():
    # Sums of +-1 +-2 +-3: |6| twice of eight
    assert sign_flip([1.0, 2.0, 3.0]) == 0.25
    assert sign_flip([1.0, -1.0]) == 1.0
    assert sign_flip([0.0, 0.0]) == 1.0
    # five equal signs of five: 2 / 32
    assert sign_flip([3.0, 1.0, 4.0, 1.0, 5.0]) == 2 / 32
    assert math.isnan(sign_flip([]))


@settings(deadline=None)
@given(st.lists(st.integers(-5, 5).map(float), min_size=2, max_size=8))
def test_sign_flip_is_scipys_permutation_test(values):
    found = stats.permutation_test(
        (np.array(values),), np.mean, permutation_type="samples", n_resamples=np.inf, vectorized=False
    )
    assert sign_flip(values) == pytest.approx(found.pvalue)


def test_many_values_are_flipped_at_random_reproducibly():
    values = [1.0 + 0.1 * i for i in range(20)]
    assert sign_flip(values) == pytest.approx(1 / 10_001)  # no random flip of 20 equal signs is as far
    rng = np.random.default_rng(0)
    noise = list(rng.normal(0.2, 1, 30))
    assert sign_flip(noise, seed=1) == sign_flip(noise, seed=1)
    assert sign_flip(noise, seed=1) == pytest.approx(stats.ttest_1samp(noise, 0).pvalue, abs=0.03)


def test_pairs_are_by_seed_and_say_what_they_are_about():
    # Differences 1, 2, 3; seed 9 is on one side only
    estimate = paired({1: 2.0, 2: 4.0, 3: 6.0, 9: 100.0}, {3: 3.0, 2: 2.0, 1: 1.0})
    assert (estimate.mean, estimate.n, estimate.p, estimate.note) == (2.0, 3, 0.25, "this checkpoint only")
    assert estimate.tie()


def test_runs_are_the_unit_from_three_runs_on():
    runs = [{0: 1.0, 1: 3.0}, {0: 2.0, 1: 4.0}, {0: 3.0, 1: 5.0, 2: 99.0}]
    three = runs_mean(runs)  # run means 2, 3, 4 on the seeds that all have
    assert (three.mean, three.n, three.unit, three.note) == (3.0, 3, "run", "")
    assert three.high - three.mean == pytest.approx(4.3027 / math.sqrt(3), abs=1e-4)
    two = runs_mean(runs[:2])  # seeds: 1.5, 3.5
    assert (two.mean, two.n, two.unit, two.note) == (2.5, 2, "seed", "this checkpoint only")


def test_two_recipes_are_compared_by_welch_over_runs():
    a = [{0: 1.0, 1: 3.0}, {0: 2.0, 1: 4.0}, {0: 6.0, 1: 5.0}]
    b = [{0: 0.0, 1: 1.0}, {0: 1.0, 1: 1.0}, {0: 0.0, 1: 0.0}, {0: 2.0, 1: 2.0}]
    means = [2.0, 3.0, 5.5], [0.5, 1.0, 0.0, 2.0]
    expected = stats.ttest_ind(*means, equal_var=False)
    found = compare_runs(a, b)
    assert found.p == pytest.approx(expected.pvalue) and found.unit == "run" and found.n == 3
    interval = expected.confidence_interval()
    assert (found.low, found.high) == pytest.approx((interval.low, interval.high))


def test_runs_against_a_fixed_policy_are_one_sample():
    start = [{0: 1.0, 1: 1.0}]
    runs = [{0: 2.0, 1: 2.0}, {0: 3.0, 1: 3.0}, {0: 4.0, 1: 4.0}]
    found = compare_runs(runs, start, fixed=True)
    assert (found.mean, found.unit, found.n) == (2.0, "run", 3)
    assert found.p == pytest.approx(stats.ttest_1samp([1.0, 2.0, 3.0], 0).pvalue)
    # The only run of another recipe is a draw of it: what is said is about the runs at hand, over tasks.
    drawn = compare_runs(runs, start)
    assert (drawn.mean, drawn.unit, drawn.n, drawn.note) == (2.0, "seed", 2, "this checkpoint only")


def test_a_weighted_sum_of_recipes_is_satterthwaite_s() -> None:
    """Of two samples Welch's; of three: by hand."""
    x, y, z = [1.0, 2.0, 3.0], [4.0, 4.0, 10.0], [0.0, 6.0, 0.0, 6.0]
    found = weighted_runs([(w, [{0: v} for v in values]) for w, values in ((1.0, x), (-0.5, y), (-0.5, z))])
    # 2 - 3 - 1.5. Variances of the means: 1/3; (12/3)/4 = 1; (12/4)/4 = 3/4.
    error, freedom = (1 / 3 + 1 + 3 / 4) ** 0.5, (25 / 12) ** 2 / (1 / 9 / 2 + 1 / 2 + 9 / 16 / 3)
    assert found.mean == pytest.approx(-2.5) and (found.n, found.unit) == (10, "run")
    assert found.p == pytest.approx(2 * stats.t.sf(2.5 / error, freedom))
    assert found.high - found.mean == pytest.approx(stats.t.ppf(0.975, freedom) * error)


def test_too_few_runs_speak_of_themselves():
    found = compare_runs([{0: 2.0, 1: 2.0}], [{0: 1.0, 1: 0.0}])
    assert (found.mean, found.n, found.note) == (1.5, 2, "this checkpoint only")


def test_runs_without_any_spread():
    """Runs that pass equally many tasks are a chance of few tasks: not certainty, but what the tasks say."""
    ones, zeros = [dict.fromkeys(range(8), 1.0)] * 3, [dict.fromkeys(range(8), 0.0)] * 3
    assert compare_runs(ones, ones).p == 1.0
    for found in (compare_runs(ones, zeros), compare_runs(ones, zeros[:1], fixed=True)):
        assert (found.n, found.note) == (8, "this checkpoint only") and found.p == pytest.approx(2 / 2**8)
    shifted = [{k: float(k == run) for k in range(8)} for run in range(3)]  # each passes another task: all 1 of 8
    found = compare_runs(shifted, zeros[:1], fixed=True)
    assert found.mean == pytest.approx(1 / 8) and found.p > 0.05


def test_runs_that_are_equal_up_to_float_noise_are_a_tie() -> None:
    # 0.1 + 0.2 is 0.3 + 5.6e-17; no run differs from another of its side.
    noisy, plain = [{0: 0.1 + 0.2}] * 3, [{0: 0.3}] * 3
    assert compare_runs(noisy, plain).tie() and compare_runs(noisy, plain[:1], fixed=True).tie()
    assert compare_runs([*noisy[:1], *plain[:2]], plain[:1], fixed=True).tie()


def test_runs_without_a_common_task_show_nothing() -> None:
    for b in ([{1: 1.0}], [{1: 1.0}] * 3):
        found = compare_runs([{0: 2.0}] * 3, b, fixed=True)
        assert found.n == 0 and math.isnan(found.mean) and math.isnan(found.p) and found.tie()


def test_a_run_with_a_value_that_is_no_number_is_refused() -> None:
    for b in ([{0: 1.0}], [{0: 1.0}] * 3):
        with pytest.raises(ValueError, match="finite"):
            compare_runs([{0: math.nan}] * 3, b, fixed=True)


def test_it_does_not_matter_which_side_is_the_recipe() -> None:
    recipe = [{k: float(k + gain) for k in range(8)} for gain in (1, 2, 6)]
    fixed = [{k: float(k) for k in range(8)}]
    ours, theirs = compare_runs(recipe, fixed, fixed=True), compare_runs(fixed, recipe, fixed=True)
    assert (theirs.mean, theirs.low, theirs.high) == (-ours.mean, -ours.high, -ours.low)
    assert (theirs.p, theirs.n, theirs.unit) == (ours.p, 3, "run") and ours.p > 0.05


@pytest.mark.parametrize("runs", [1, 3])
def test_a_side_without_any_value_is_not_a_side_of_zeros(runs: int) -> None:
    played = [{k: 5.0 + run for k in range(8)} for run in range(runs)]
    for a, b in ((played, []), ([], played)):
        estimate = compare_runs(a, b)
        assert math.isnan(estimate.mean) and math.isnan(estimate.p) and estimate.n == 0 and estimate.tie()


def test_the_mean_of_runs_without_a_common_task_is_no_number() -> None:
    estimate = runs_mean([{"a": 1.0}, {"b": 2.0}, {"c": 3.0}])
    assert math.isnan(estimate.mean) and (estimate.n, estimate.unit) == (0, "run") and estimate.note


@pytest.mark.parametrize("n", [1, 2, 5, 8])
def test_the_smallest_p_is_that_of_values_of_one_sign(n: int) -> None:
    assert least_p(n) == sign_flip([1.0 + i for i in range(n)])


@pytest.mark.parametrize("value", [0.0, 0.1, 1.0, 1e6])
def test_equal_values_have_no_interaction(value: float) -> None:
    def made(step: float) -> list[dict[str, object]]:
        return [
            {"seed": s, "a": a, "b": b, "y": value + step * (a + b)} for s in range(8) for a in (0, 1) for b in (0, 1)
        ]

    for step in (0.0, 0.3):  # all the same; a sum of effects, equal in every cluster up to float noise
        [found] = interactions(made(step), "y", ("a", "b")).values()
        assert (found.mean, found.p) == (0.0, 1.0) and found.tie()


def test_interactions_refuse_what_is_no_number() -> None:
    rows = [{"seed": s, "a": a, "b": b, "y": math.nan if s else 1.0} for s in range(3) for a in "xy" for b in "xy"]
    with pytest.raises(ValueError, match="finite"):
        interactions(rows, "y", ("a", "b"))


def test_holm_steps_down():
    # sorted .01 .03 .04: 3 * .01, 2 * .03, max(.06, .04); NaN does not count
    assert holm([0.04, math.nan, 0.01, 0.03]) == pytest.approx([0.06, math.nan, 0.03, 0.06], nan_ok=True)
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    table = corrected([Estimate(1, 0, 2, 9, p=0.03), Estimate(1, 0, 2, 9, p=0.04)])
    assert [e.p for e in table] == [0.06, 0.06] and all(e.tie() for e in table)


@settings(deadline=None)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_is_statsmodels(p_values):
    from statsmodels.stats.multitest import multipletests

    assert holm(p_values) == pytest.approx(list(multipletests(p_values, method="holm")[1]))


def test_bootstrap_is_refused_for_few_values_and_near_the_t_interval_for_many():
    with pytest.raises(ValueError, match="bootstrap of 31 values would be too narrow; it needs 32"):
        bootstrap([0.0] * 31)
    values = list(np.random.default_rng(0).normal(0, 1, 200))
    a, b = bootstrap(values), mean_interval(values)
    assert (a.low, a.high) == pytest.approx((b.low, b.high), abs=0.02)
    assert bootstrap(values, seed=1) == bootstrap(values, seed=1) != bootstrap(values, seed=2)


def test_interquartile_mean_leaves_out_a_quarter_on_each_side():
    # 0 .. 31 and far outliers in the outer quarters: the middle 16 are 8 .. 23, mean 15.5
    values = [-1e6 if i < 8 else 1e6 if i > 23 else float(i) for i in range(32)]
    assert interquartile_mean(values).mean == 15.5


def test_performance_profile():
    assert performance_profile([0.0, 1.0, 2.0, 2.0], [-1, 0, 1.5, 2]) == [1.0, 0.75, 0.5, 0.0]
    with pytest.raises(ValueError, match="leave failed episodes out"):  # NaN is above nothing, and would count
        performance_profile([1.0, math.nan], [0.5])


def test_minimum_detectable_effect():
    # n = 32, power .8, two-sided .05: d = .5116 (statsmodels); by simulation, the power there is .8
    effect = minimum_detectable_effect(2.0, 32)
    assert effect == pytest.approx(1.0232, abs=2e-3)
    rng = np.random.default_rng(0)
    found = [stats.ttest_1samp(rng.normal(effect, 2.0, 32), 0).pvalue < 0.05 for _ in range(2000)]
    assert np.mean(found) == pytest.approx(0.8, abs=0.03)
    with pytest.raises(ValueError, match="n=1"):
        minimum_detectable_effect(1.0, 1)


def rows(cells, seeds=8, noise=0.0):
    rng = np.random.default_rng(0)
    day = rng.normal(0, 3, seeds)
    return [
        {"reasoning": a, "memory": b, "seed": s, "return": value + day[s] + noise * rng.normal()}
        for (a, b), value in cells.items()
        for s in range(seeds)
    ]


def test_interaction_is_the_departure_from_the_sum():
    # react +1, dc +2, both +5 instead of +3: interaction 2
    cells = {("direct", "base"): 0.0, ("react", "base"): 1.0, ("direct", "dc"): 2.0, ("react", "dc"): 5.0}
    found = interactions(rows(cells, noise=0.01), "return", ("reasoning", "memory"))
    assert list(found) == [("react", "dc")]
    assert found["react", "dc"].mean == pytest.approx(2.0, abs=0.02) and not found["react", "dc"].tie()


def test_interactions_are_statsmodels_formula():
    import pandas
    import statsmodels.formula.api as smf

    cells = {(a, b): float(i) for i, (a, b) in enumerate(itertools.product("xyz", "pq"))}
    data = rows(cells, noise=1.0)
    frame = pandas.DataFrame(data).rename(columns={"return": "value"})
    fitted = smf.ols("value ~ C(reasoning) * C(memory)", frame).fit(
        cov_type="cluster", cov_kwds={"groups": frame["seed"]}, use_t=True
    )
    found = interactions(data, "return", ("reasoning", "memory"))
    names = ["C(reasoning)[T.y]:C(memory)[T.q]", "C(reasoning)[T.z]:C(memory)[T.q]"]
    assert [e.mean for e in found.values()] == pytest.approx([fitted.params[n] for n in names])
    assert [e.low for e in found.values()] == pytest.approx([fitted.conf_int()[0][n] for n in names])
    assert [e.p for e in found.values()] == pytest.approx(holm([fitted.pvalues[n] for n in names]))


def test_a_design_with_holes_has_no_interactions():
    cells = {("direct", "base"): 0.0, ("react", "base"): 1.0, ("direct", "dc"): 2.0}
    with pytest.raises(ValueError, match=r"missing: \[\('react', 'dc'\)\]"):
        interactions(rows(cells), "return", ("reasoning", "memory"))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_refused(bad):
    with pytest.raises(ValueError, match="leave failed episodes out"):
        mean_interval([1.0, bad])
