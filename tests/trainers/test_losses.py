"""Losses: exact numbers of our own, and what the table says of each."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("trl")

from agentspec.registry import SpecError
from trainers.losses import (
    LOSSES,
    LossSpec,
    UpdateSize,
    above_cap,
    divergence,
    dppo,
    loss,
    probability_moved,
    pushed_outside,
)

SIZE = UpdateSize(tokens=30, rollouts=8, length=100)


def logs(*values: float) -> torch.Tensor:
    return torch.tensor([[math.log(v) for v in values]])


def test_what_each_loss_divides_by() -> None:
    ours = {"dapo": 30, "cispo": 30, "dppo": 30, "dr_grpo": 800}  # 8 rollouts x 100, whatever was sampled
    assert {name: LOSSES[name].denominator(SIZE) for name in ours} == ours
    per_token = {name: spec.per_token for name, spec in LOSSES.items()}
    assert {name: per_token[name] for name in ours} == {"dapo": True, "cispo": True, "dppo": True, "dr_grpo": False}
    assert not per_token["grpo"] and not per_token["bnpo"]  # they depend on rows


def test_what_is_clipped() -> None:
    old, new = logs(0.5, 0.5, 0.5), logs(0.35, 0.5, 0.65)  # ratios 0.7, 1, 1.3
    positive, negative = torch.tensor([[1.0]]), torch.tensor([[-1.0]])
    limits = {"low": 0.2, "high": 0.2}
    assert pushed_outside(new, old, positive, **limits).tolist() == [[False, False, True]]
    assert pushed_outside(new, old, negative, **limits).tolist() == [[True, False, False]]
    assert above_cap(new, old, positive, low=0.2, high=1.2).tolist() == [[False, False, True]]
    assert not above_cap(new, old, negative, low=0.2, high=1.2).any()
    # The probability moved by -.15, 0 and .15.
    assert probability_moved(new, old, positive, low=0.1, high=0.1).tolist() == [[False, False, True]]
    assert probability_moved(new, old, negative, low=0.1, high=0.1).tolist() == [[True, False, False]]
    assert not probability_moved(new, old, positive, **limits).any()


def test_dppo_bounds_the_change_of_the_probability() -> None:
    old = logs(0.001, 0.5, 0.5)
    new = logs(0.002, 0.65, 0.35).requires_grad_()
    value = dppo(new, old, torch.tensor([[2.0]]), low=0.1, high=0.1)
    # A rare token that doubled stays (moved by .001, ratio 2); .5 -> .65 is outside; .5 -> .35 went against the push.
    assert torch.allclose(value, torch.tensor([[-4.0, 0.0, -1.4]]))
    value.sum().backward()
    # d(-r A) / d log p = -r A where the token is inside.
    assert torch.allclose(new.grad, torch.tensor([[-4.0, 0.0, -1.4]]))


def test_the_divergence_is_zero_at_the_reference_only() -> None:
    # exp(d) - d - 1 with d = log(.25 / .5) = -.693: .5 + .693 - 1 = .193.
    assert torch.allclose(divergence(logs(0.5, 0.5), logs(0.5, 0.25)), torch.tensor([[0.0, 0.1931]]), atol=1e-4)


def test_what_is_not_offered_says_why() -> None:
    with pytest.raises(SpecError, match=r"luspo.*once per row"):
        loss("luspo")
    with pytest.raises(SpecError, match=r"did you mean (dapo|dppo)"):
        loss("dappo")


def test_a_row_is_computed_one_way() -> None:
    """By TRL's code or by ours, never both; an added row is found by its name."""
    assert all(bool(spec.trl) != bool(spec.objective) for spec in LOSSES.values())
    assert LossSpec("x", "y", trl="dapo").per_token
