"""Exact numbers of the estimators, and the mistakes they must not make (numbers from other implementations)."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.registry import SpecError
from trainers.credit import CreditRule, Outcome
from trainers.estimators import (
    ESTIMATORS,
    EstimatorSpec,
    discounted,
    estimator,
    gigpo,
    grpo,
    max_rl,
    reward_to_go,
    rloo,
)

PER_EPISODE = [name for name, spec in ESTIMATORS.items() if not spec.per_step]


def rounded(values: list[float], digits: int = 3) -> list[float]:
    return [round(v, digits) for v in values]


def close(got: list[list[float]], expected: list[list[float]]) -> bool:
    return all(
        math.isclose(a, b, abs_tol=2e-3) for g, e in zip(got, expected, strict=True) for a, b in zip(g, e, strict=True)
    )


def test_grpo_equals_trl_numbers() -> None:
    # Mean 11.25, sample deviation 4.787: (15 - 11.25) / 4.7872 = .783.
    assert rounded(grpo([15.0, 10.0, 5.0, 15.0])) == [0.783, -0.261, -1.306, 0.783]
    # Mean .375, sample deviation .4787 + 1e-4: .625/.4788 = 1.305, -.375/.4788 = -.783, .125/.4788 = .261.
    advantages = grpo([1.0, 0.0, 0.0, 0.5])
    assert rounded(advantages) == [1.305, -0.783, -0.783, 0.261]
    # With the population deviation (x sqrt(4/3)) these are the numbers of TRL's async trainer.
    population = [a * (0.4787 + 1e-4) / 0.4787 * math.sqrt(4 / 3) for a in advantages]
    assert rounded(population, 2) == [1.51, -0.9, -0.9, 0.3]


def test_rloo_is_each_less_the_mean_of_the_others() -> None:
    assert rloo([1.0, 0.0]) == [1.0, -1.0]
    # Three: 3 - mean(1, 2) = 1.5, and so on.
    assert rounded(rloo([3.0, 1.0, 2.0])) == [1.5, -1.5, 0.0]


def test_max_rl_divides_by_the_mean() -> None:
    # One success of four: mean .25, (1 - .25) / .25 = 3 and -.25 / .25 = -1; three of four: 1/3 and -1.
    assert max_rl([1.0, 0.0, 0.0, 0.0]) == [3.0, -1.0, -1.0, -1.0]
    assert rounded(max_rl([1.0, 1.0, 1.0, 0.0])) == [0.333, 0.333, 0.333, -1.0]
    # Summed over the group, a success counts 1 / p - 1 whatever p is: K ((1 - p) / p) - (N - K) = 0.
    assert max_rl([0.0, 0.0]) == [0.0, 0.0] and max_rl([2.0, 2.0]) == [0.0, 0.0] and max_rl([]) == []
    with pytest.raises(SpecError, match=r"expected returns >= 0, got \[1.0, -0.5\]"):
        max_rl([1.0, -0.5])


@pytest.mark.parametrize("name", PER_EPISODE)
def test_groups_without_signal_get_exactly_zero(name: str) -> None:
    noise = [0.1, 0.1 + 1e-9, 0.1, 0.1 - 1e-9]
    for returns in (noise, [3.0], []):
        assert ESTIMATORS[name].function(returns) == [0.0] * len(returns)


@given(st.lists(st.floats(0, 100), min_size=0, max_size=8), st.sampled_from(PER_EPISODE))
def test_advantages_of_a_group_sum_to_zero_where_it_is_declared(values: list[float], name: str) -> None:
    advantages = ESTIMATORS[name].function(values)
    assert len(advantages) == len(values)
    if ESTIMATORS[name].zero_sum:
        assert abs(math.fsum(advantages)) < 1e-6


def test_discounted() -> None:
    assert discounted([1.0, 0.0, 2.0], 1.0) == [3.0, 2.0, 2.0]
    assert discounted([1.0, 0.0, 2.0], 0.5) == [1.5, 1.0, 2.0]
    assert discounted([], 0.9) == []


def test_reward_to_go_baseline_per_step() -> None:
    # To go: [3, 2], [1, 0] -> means [2, 1] -> centred [1, 1], [-1, -1]; deviation sqrt(4 / 3) = 1.1547.
    assert close(reward_to_go([[1.0, 2.0], [1.0, 0.0]]), [[0.866, 0.866], [-0.866, -0.866]])


def test_an_ended_rollout_earns_nothing_more() -> None:
    # To go: [2], [0, 4] gives [4, 4]; means: step 0 (2 + 4) / 2 = 3, step 1 (0 + 4) / 2 = 2.
    got = reward_to_go([[2.0], [0.0, 4.0]])
    # Centred [-1], [1, 2]: mean 2/3, deviation sqrt((25 + 1 + 16) / 9 / 2) = 1.5275.
    assert close(got, [[-0.655], [0.655, 1.309]])
    assert reward_to_go([[1.0, 2.0]]) == [[0.0, 0.0]] and reward_to_go([]) == []
    assert reward_to_go([[1.0], [1.0]]) == [[0.0], [0.0]]


def test_the_deviation_of_ragged_groups_is_about_their_mean() -> None:
    """To go [4], [0, 0], [2, 1]: means 2 and (0 + 0 + 1) / 3, so that the five values centred do not sum to zero.

    They are 2, -2, -1/3, 0, 2/3, of mean 1/15: squares about it sum to 77/9 - 5/225 = 128/15, of which 1/4 is 32/15.
    """
    got = reward_to_go([[4.0], [0.0, 0.0], [1.0, 1.0]])
    divisor = math.sqrt(32 / 15) + 1e-4
    expected = [[2.0], [-2.0, -1 / 3], [0.0, 2 / 3]]
    assert [len(g) for g in got] == [1, 2, 2]
    for values, centred in zip(got, expected, strict=True):
        assert values == pytest.approx([v / divisor for v in centred], rel=1e-12, abs=1e-15)


def test_gigpo_compares_actions_taken_in_the_same_state() -> None:
    # Both start in "a"; one goes on to "b", one to "c". Totals 2 and 0: episode advantages +-1 / 1.4142 = +-.707.
    # Step group "a": to go 2 and 0: +-.707 again. "b" and "c" were met once: 0.
    anchors = [["a", "b"], ["a", "c"]]
    assert close(gigpo([[0.0, 2.0], [0.0, 0.0]], anchors=anchors), [[1.414, 0.707], [-1.414, -0.707]])
    without = gigpo([[0.0, 2.0], [0.0, 0.0]], anchors=anchors, gigpo_weight=0.0)
    assert close(without, [[0.707, 0.707], [-0.707, -0.707]])
    with pytest.raises(ValueError, match="2 steps and 1 anchor"):
        gigpo([[0.0, 1.0]], anchors=[["a"]])


def test_an_estimator_is_one_function_and_one_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stranger's row: credit uses it, gives it what it needs, and nobody expects its advantages to sum to zero."""

    def above(returns: list[float], *, gamma: float) -> list[float]:
        return [gamma * max(0.0, r) for r in returns]

    monkeypatch.setitem(ESTIMATORS, "above", EstimatorSpec("above", above, "x", zero_sum=False, needs=("gamma",)))
    rule = CreditRule(group=2, estimator="above", gamma=0.5)
    assert rule.advantages([Outcome((1.0, 3.0)), Outcome((-1.0,))]) == [2.0, 0.0]
    assert not estimator("above").zero_sum
    with pytest.raises(SpecError, match="unknown estimator 'abov'; did you mean above"):
        replace(rule, estimator="abov").advantages([Outcome((1.0,)), Outcome((0.0,))])
