"""The diagonal of a transfer matrix against the rest, by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest

from eval.statistics import LEAST_RUNS, RESAMPLES, at_home, contrasts, diagonal

HOME = {"a": "x", "b": "y"}


def cells(
    a: list[tuple[float, float]], b: list[tuple[float, float]]
) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """Two arms, home x and y; each run is (value in x, value in y), on one task."""
    named = {"a": a, "b": b}
    return {
        arm: {str(i): {"x": {"t": x}, "y": {"t": y}} for i, (x, y) in enumerate(runs)} for arm, runs in named.items()
    }


def test_the_diagonal_over_training_runs_by_hand() -> None:
    played = cells([(5, 1), (6, 1), (7, 1)], [(4, 3), (4, 5), (4, 7)])
    # Contrasts: of a 4, 5, 6 (mean 5, variance 1), of b -1, 1, 3 (mean 1, variance 4).
    assert [run["t"] for run in contrasts(played, HOME)["a"].values()] == [4, 5, 6]
    assert [run["t"] for run in contrasts(played, HOME)["b"].values()] == [-1, 1, 3]
    found = diagonal(played, HOME)
    # (5 + 1) / 2 = 3. Error: sqrt(1/4 (1/3 + 4/3)) = sqrt(5/12) = .6455, t = 4.6476.
    # Satterthwaite: (5/12)^2 / ((1/12)^2 / 2 + (1/3)^2 / 2) = (25/144) / (17/288) = 50/17 = 2.941 degrees of freedom.
    from scipy import stats

    half = stats.t.ppf(0.975, 50 / 17) * math.sqrt(5 / 12)
    assert found.estimate.mean == pytest.approx(3)
    assert (found.estimate.low, found.estimate.high) == pytest.approx((3 - half, 3 + half))
    assert found.estimate.p == pytest.approx(2 * stats.t.sf(3 / math.sqrt(5 / 12), 50 / 17))
    assert 2.07 < half < 2.09 and 0.018 < found.estimate.p < 0.022  # t tables: 3.18 at 3 degrees, 4.30 at 2
    assert (found.estimate.n, found.estimate.unit, found.estimate.note) == (6, "run", "")


def test_neither_easy_scaffolds_nor_good_learners_are_a_diagonal() -> None:
    # Value = how well the arm has learnt + how easy the scaffold is (y: 10 more), and nothing else.
    found = diagonal(cells([(1, 11), (2, 12), (3, 13)], [(7, 17), (7, 17), (8, 18)]), HOME)
    assert found.estimate.mean == pytest.approx(0) and found.estimate.p == 1 and found.estimate.tie()
    # With two homes the other assignment is always as far from 0: that is no test.
    assert math.isnan(found.permutation) and math.isnan(found.least) and found.assignments == 2


def test_fewer_than_three_runs_speak_of_their_checkpoints_only() -> None:
    two = cells([(5, 1), (6, 1)], [(4, 3), (4, 5), (4, 7)])
    for runs in two.values():
        for of in runs.values():
            of["x"]["u"], of["y"]["u"] = of["x"]["t"] + 1, of["y"]["t"]
    found = diagonal(two, HOME).estimate
    # Task t: (4.5 + 1) / 2 = 2.75. Task u: x is 1 more, so a's contrast rises and b's falls by 1: 2.75 again.
    assert (found.mean, found.n, found.unit, found.note) == (2.75, 2, "seed", "this checkpoint only")
    assert found.p == 0.5  # of four flips of two equal numbers, two are as far


def test_all_assignments_of_homes_are_counted() -> None:
    arms = {"a": "x", "b": "y", "c": "z"}
    grid = {"a": (3, 0, 0), "b": (0, 3, 0), "c": (0, 0, 3)}
    played = {
        arm: {str(i): dict(zip("xyz", ({"t": float(v)} for v in row), strict=True)) for i in range(3)}
        for arm, row in grid.items()
    }
    found = diagonal(played, arms)
    # Rows less their means: 2 on the diagonal, -1 elsewhere. Six assignments: 6 once (all at home), 0 three times (one
    # at home: 2 - 1 - 1), -3 twice: only the real one is as far from 0.
    assert (found.permutation, found.assignments, found.least) == (pytest.approx(1 / 6), 6, 1 / 6)
    assert found.estimate.mean == 3 and found.estimate.note == "this checkpoint only"  # no run varies


@pytest.mark.parametrize(("n", "tried"), [(2, 2), (3, 6), (4, 24), (7, 5040), (8, 1 + RESAMPLES)])
def test_how_small_the_permutation_can_be(n: int, tried: int) -> None:
    """A diagonal that stands alone: of all n! assignments, or of those that were drawn at random."""
    homes = [f"h{i}" for i in range(n)]
    played = {h: {"0": {s: {"t": float(s == h)} for s in homes}} for h in homes}
    found = diagonal(played, dict(zip(homes, homes, strict=True)))
    assert (found.tried, found.assignments) == (tried, math.factorial(n))
    if n == 2:
        assert math.isnan(found.permutation) and math.isnan(found.least)
    else:
        assert found.permutation == pytest.approx(found.least) == pytest.approx(1 / tried)


def test_arms_of_one_home_count_together_once() -> None:
    played = cells([(4, 0)] * 3, [(0, 2)] * 3)
    played["c"] = {str(i): {"x": {"t": 2.0}, "y": {"t": 0.0}} for i in range(3)}
    # Home x: contrasts 4 (a) and 2 (c), mean 3; home y: 2. Homes weigh the same: 2.5.
    assert diagonal(played, {**HOME, "c": "x"}).estimate.mean == 2.5


def test_what_is_compared_in_one_scaffold() -> None:
    own = at_home(cells([(5, 1), (6, 1), (7, 1)], [(4, 3), (4, 5), (4, 7)]), HOME)
    assert own["x"].mean == pytest.approx(2) and own["y"].mean == pytest.approx(4)  # 6 - 4, and 5 - 1
    assert own["x"].unit == own["y"].unit == "run"
    # Home x has two arms, 6 and 2 on average there, and counts once: 4 - 4. The others: 4 - (1 + 0) / 2.
    played = {**cells([(5, 1), (6, 1), (7, 1)], [(4, 3), (4, 5), (4, 7)])}
    played["c"] = {str(i): {"x": {"t": 2.0 + i - 1}, "y": {"t": 0.0}} for i in range(3)}
    own = at_home(played, {**HOME, "c": "x"})
    assert (own["x"].mean, own["y"].mean) == (pytest.approx(0), pytest.approx(4.5)) and own["x"].n == 9


def test_a_single_run_of_an_arm_is_a_draw_and_no_fixed_policy() -> None:
    """Against three runs of another it has no deviation of its own: over tasks, and said so."""
    own = at_home(cells([(5, 1)] * LEAST_RUNS, [(4, 3)]), HOME)
    for found in own.values():
        assert (found.unit, found.note) == ("seed", "this checkpoint only") and found.p == 1.0  # one task


@pytest.mark.parametrize("test", [diagonal, at_home])
def test_what_cannot_be_compared_is_told(test: Any) -> None:
    played = cells([(5, 1)] * 3, [(4, 3)] * 3)
    with pytest.raises(ValueError, match="b has no run; leave it out"):
        test({**played, "b": {}}, HOME)
    with pytest.raises(ValueError, match="needs two scaffolds"):
        test({"a": played["a"]}, HOME)


def test_tasks_that_a_cell_lacks_are_left_out_and_holes_refused() -> None:
    played = cells([(5, 1)] * 3, [(4, 3)] * 3)
    played["a"]["0"]["x"]["only here"] = 100.0
    assert diagonal(played, HOME).estimate.mean == pytest.approx((4 - 1) / 2)
    with pytest.raises(ValueError, match="needs two scaffolds"):
        diagonal({"a": played["a"]}, HOME)
    del played["b"]["1"]["y"]
    with pytest.raises(ValueError, match="run 1 of b has no value in y"):
        diagonal(played, HOME)


def test_the_permutation_looks_at_the_tasks_of_the_estimate() -> None:
    """A task that one cell alone has changes neither."""
    homes = ["x", "y", "z"]
    cells = {h: {"0": {s: {"t": float(s == h)} for s in homes}} for h in homes}
    home = dict(zip(homes, homes, strict=True))
    before = diagonal(cells, home)
    cells["x"]["0"]["x"]["hard"] = -9.0
    after = diagonal(cells, home)
    assert (after.estimate.mean, after.permutation) == (before.estimate.mean, before.permutation) == (1.0, 1 / 6)
