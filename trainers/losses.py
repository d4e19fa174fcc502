"""Losses: the objective of a token and what the sum is divided by. One function and one row of `LOSSES` adds one.

TRL's losses are TRL's code: such a row names the `loss_type` that computes it; a row of ours brings an `objective`. The
trainer, the configuration check, the clip shares, the audit and the table in the docs follow from the row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from agentspec.actions import suggest
from agentspec.registry import SpecError

if TYPE_CHECKING:
    from torch import Tensor  # only the tensors it is given are touched: the audit reads this table without it

Objective = Callable[..., "Tensor"]
"""`(logps, old, advantages, *, low, high)` -> loss per token; (B, T) each, advantages (B, 1) or (B, T)."""


@dataclass(frozen=True)
class UpdateSize:
    """What a loss may be divided by: of one generation round, all ranks together.

    Args:
        tokens: trained tokens of all rows.
        rollouts: episodes played, failed ones among them.
        length: `max_completion_length` of the configuration.
    """

    tokens: int
    rollouts: int
    length: int


def trained_tokens(size: UpdateSize) -> int:
    """Every trained token of the update has the same weight."""
    return size.tokens


def constant_length(size: UpdateSize) -> int:
    """A constant: rollouts x `max_completion_length`, whatever was sampled (Liu et al., 2025)."""
    return size.rollouts * size.length


def pushed_outside(logps: Tensor, old: Tensor, advantages: Tensor, *, low: float, high: float) -> Tensor:
    """PPO's clipping: the ratio has left [1 - low, 1 + high] on the side that the advantage pushes to."""
    ratio = (logps - old).exp()
    return ((ratio < 1 - low) & (advantages < 0)) | ((ratio > 1 + high) & (advantages > 0))


def above_cap(logps: Tensor, old: Tensor, advantages: Tensor, *, low: float, high: float) -> Tensor:
    """CISPO's cap: the ratio is above `high` (a bound, not a distance from 1), where the advantage is positive."""
    return ((logps - old).exp() > high) & (advantages > 0)


def probability_moved(logps: Tensor, old: Tensor, advantages: Tensor, *, low: float, high: float) -> Tensor:
    """DPPO's trust region: the token's probability moved by more than `low` or `high` where it is pushed to."""
    moved = logps.exp() - old.exp()
    return ((moved < -low) & (advantages < 0)) | ((moved > high) & (advantages > 0))


def dppo(logps: Tensor, old: Tensor, advantages: Tensor, *, low: float, high: float) -> Tensor:
    """Divergence PPO with the binary total variation (arXiv 2602.04879): `-ratio A`, 0 outside the trust region.

    `epsilon` and `epsilon_high` bound the change of the probability itself: a rare token's ratio says little of it.
    """
    outside = probability_moved(logps.detach(), old, advantages, low=low, high=high)
    return (-(logps - old).exp() * advantages).masked_fill(outside, 0.0)


@dataclass(frozen=True)
class LossSpec:
    """One row of the table.

    Args:
        trl: TRL's `loss_type` whose code computes it; empty where `objective` does.
        denominator: what the sum over the update is divided by, where it is one number.
        clipped: which tokens lose their gradient to clipping; arguments as of `objective`.
        uses: settings of the configuration that it reads.
        depends_on_rows: how it depends on the way episodes split into rows; empty if it does not.
        row_mean: whether it is a mean over rows; padding rows, which TRL would count, are none.
    """

    name: str
    summary: str
    trl: str = ""
    objective: Objective | None = None
    denominator: Callable[[UpdateSize], int] = trained_tokens
    clipped: Objective = pushed_outside
    uses: tuple[str, ...] = ("epsilon", "epsilon_high", "delta")
    depends_on_rows: str = ""
    row_mean: bool = False

    @property
    def per_token(self) -> bool:
        """Whether it is a sum over tokens divided by their number (then advantages can be scaled per rollout)."""
        return not self.depends_on_rows and self.denominator is trained_tokens


LOSSES: dict[str, LossSpec] = {
    spec.name: spec
    for spec in (
        LossSpec("dapo", "clipped ratio x advantage, / trained tokens of the update", trl="dapo"),
        LossSpec(
            "cispo",
            "capped ratio (no gradient) x advantage x log-probability, / trained tokens of the update",
            trl="cispo",
            clipped=above_cap,
            uses=("epsilon_high",),
        ),
        LossSpec(
            "dr_grpo",
            "clipped ratio x advantage, / (rollouts x max_completion_length)",
            trl="dapo",
            denominator=constant_length,
            uses=("epsilon", "epsilon_high", "delta", "max_completion_length"),
        ),
        LossSpec(
            "dppo",
            "ratio x advantage while the token's probability moved by at most epsilon, / trained tokens of the update",
            objective=dppo,
            clipped=probability_moved,
            uses=("epsilon", "epsilon_high"),
        ),
        LossSpec(
            "grpo",
            "clipped ratio x advantage: mean over rows of the mean over a row's tokens",
            trl="grpo",
            depends_on_rows="each row has the same weight: an episode of three rows counts three times one of one row",
            row_mean=True,
        ),
        LossSpec(
            "bnpo",
            "clipped ratio x advantage: mean over micro-batches of the mean over their tokens",
            trl="bnpo",
            depends_on_rows="each micro-batch is normalised by its own tokens, so weights depend on the partition",
        ),
    )
}
"""Every loss by name."""

REFUSED = {
    "luspo": "it sums per row, so an episode counts once per row",
    "sapo": "it averages per row, so an episode of three rows counts three times one of a single row",
    "vespo": "its weights are products over one row, not over the episode",
}
"""TRL's losses that are not offered, and why."""


def loss(name: str) -> LossSpec:
    """The row of `name`; `SpecError` if there is none, or it is not offered."""
    if name in REFUSED:
        raise SpecError(f"loss_type {name!r} is not offered: {REFUSED[name]}; use one of {', '.join(LOSSES)}")
    if name not in LOSSES:
        raise SpecError(f"unknown loss_type {name!r}{suggest(name, LOSSES)}")
    return LOSSES[name]


def divergence(logps: Tensor, reference: Tensor) -> Tensor:
    """Unbiased estimate of the divergence from the reference per token (Schulman's k3), as TRL's."""
    return (reference - logps).exp() - (reference - logps) - 1
