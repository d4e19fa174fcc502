"""Exact numbers of the estimators, and the mistakes they must not make (numbers from other implementations)."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from trainers.advantages import ESTIMATORS, centred, grpo, per_sequence, rloo, zero_variance


def rounded(values: torch.Tensor, digits: int = 3) -> list[float]:
    return [round(v, digits) for v in values.flatten().tolist()]


def test_grpo_equals_trl_numbers() -> None:
    # Mean 11.25, sample deviation 4.787: (15 - 11.25) / 4.7872 = .783.
    assert rounded(grpo(torch.tensor([[15.0, 10.0, 5.0, 15.0]]))) == [0.783, -0.261, -1.306, 0.783]


def test_rows_per_episode_do_not_move_the_baseline() -> None:
    # Rewards [1, 0, 0, .5] with 3, 1, 1, 2 segments. Normalised over rows the fourth would be -.172: its sign flips.
    advantages = grpo(torch.tensor([[1.0, 0.0, 0.0, 0.5]], dtype=torch.float64)).flatten()
    # Mean .375, sample deviation .4787 + 1e-4: .625/.4788 = 1.305, -.375/.4788 = -.783, .125/.4788 = .261.
    assert rounded(advantages) == [1.305, -0.783, -0.783, 0.261]
    rows = per_sequence(advantages, [0, 0, 0, 1, 2, 3, 3])
    assert rounded(rows) == [1.305] * 3 + [-0.783] * 2 + [0.261] * 2
    # With the population deviation (x sqrt(4/3)) these are the numbers of TRL's async trainer.
    assert rounded(advantages * (0.4787 + 1e-4) / 0.4787 * math.sqrt(4 / 3), 2) == [1.51, -0.9, -0.9, 0.3]


def test_centred_over_rollouts_not_rows() -> None:
    # Episode 0 has 3 rows and reward 1, episode 1 has 2 rows and reward 0: over rows it would be [.4 x3, -.6 x2].
    rows = per_sequence(centred(torch.tensor([[1.0, 0.0]])).flatten(), [0, 0, 0, 1, 1])
    assert rounded(rows) == [0.5, 0.5, 0.5, -0.5, -0.5]


def test_rloo_over_rollouts_not_rows() -> None:
    # Each minus the mean of the others: 1 - 0 and 0 - 1.
    rows = per_sequence(rloo(torch.tensor([[1.0, 0.0]])).flatten(), [0, 0, 0, 1, 1])
    assert rounded(rows) == [1.0, 1.0, 1.0, -1.0, -1.0]
    # Three: 3 - mean(1, 2) = 1.5, and so on.
    assert rounded(rloo(torch.tensor([[3.0, 1.0, 2.0]]))) == [1.5, -1.5, 0.0]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_unscorable_rollouts_count_nowhere(name: str) -> None:
    with_failure = ESTIMATORS[name](torch.tensor([[1.0, math.nan, 0.0, 0.5]]))
    without = ESTIMATORS[name](torch.tensor([[1.0, 0.0, 0.5]]))
    assert with_failure[0, 1] == 0
    assert torch.allclose(with_failure[0, [0, 2, 3]], without[0])


@pytest.mark.parametrize("name", ESTIMATORS)
def test_groups_without_signal_get_exactly_zero(name: str) -> None:
    equal = torch.full((1, 4), 0.1) + torch.tensor([[0.0, 1e-9, 0.0, -1e-9]])
    alone = torch.tensor([[math.nan, math.nan, 3.0, math.nan]])
    nobody = torch.full((1, 4), math.nan)
    for returns in (equal, alone, nobody):
        advantages = ESTIMATORS[name](returns)
        assert advantages.abs().max() < 1e-6 and advantages.isfinite().all()
        assert zero_variance(returns).tolist() == [True]
    assert zero_variance(torch.tensor([[0.0, 1.0]])).tolist() == [False]


@given(
    st.lists(st.floats(-100, 100), min_size=2, max_size=8),
    st.lists(st.booleans(), min_size=8, max_size=8),
    st.sampled_from(sorted(ESTIMATORS)),
)
def test_advantages_of_a_group_sum_to_zero(values: list[float], failed: list[bool], name: str) -> None:
    returns = torch.tensor([[math.nan if f else v for v, f in zip(values, failed, strict=False)]], dtype=torch.float64)
    assert abs(ESTIMATORS[name](returns).sum().item()) < 1e-6
