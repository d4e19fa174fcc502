"""The receipt of a generation round: what the update used, and of whom it says that it used it.

The trainer writes one from what it holds in memory, the audit makes the same from the recorded episodes and compares
them field by field. A receipt names the round's episodes with their returns; every row with its advantage and digests
of what the loss read; the loss denominator; the number of padding rows; the settings of credit and loss.
Equal updates have equal receipts, but for the `chain`: it holds digests of records in which times stand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.files import jsonable
from agentspec.records.digests import short_digest
from agentspec.records.folder import FORMAT
from trainers.credit import FIELDS
from trainers.sequences import Row

LOSS_SETTINGS = (
    "loss_type epsilon epsilon_high delta beta reference use_bias_correction_kl top_entropy_quantile "
    "max_completion_length num_iterations steps_per_generation gradient_accumulation_steps learning_rate "
    "lr_scheduler_type warmup_steps max_grad_norm seed"
)
"""Fields of a configuration that an update depends on beside those of credit."""


def settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """What an update depends on, of a configuration as plain data."""
    return {name: jsonable(config[name]) for name in (*FIELDS, *LOSS_SETTINGS.split())}


def row_digest(tokens: Sequence[int], mask: Sequence[int], advantage: float | Sequence[float]) -> str:
    """12 hex digits over what a row is and earns: tokens, mask and advantages, these to seven digits."""
    values = [advantage] if isinstance(advantage, (int, float)) else advantage
    return short_digest([tokens, mask, [f"{v:.6e}" for v in values]])


def receipt_rows(rows: Sequence[Row], first: int = 0) -> list[dict[str, Any]]:
    """What a receipt says of each row; `sampling` is a digest of the distributions its tokens were sampled from.

    Args:
        first: place of this rank's first episode among those of all ranks.
    """
    return [
        {
            "episode": first + r.episode,
            "tokens": len(s),
            "trained": s.trained,
            "advantage": r.advantage,
            "digest": row_digest(s.tokens, s.mask, r.advantage),
            "sampling": short_digest([s.logprobs, s.temperatures, sorted(s.allowed.items())]),
        }
        for r in rows
        for s in [r.sequence]
    ]


def receipt_record(
    *,
    round: int,
    played: Sequence[tuple[str, float | None]],
    rows: Sequence[Mapping[str, Any]],
    padding_rows: int,
    denominator: int,
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """A receipt but for its chain: `played` are id and return of every episode, `rows` those of all ranks."""
    return {
        "format": FORMAT,
        "round": round,
        "episodes": [name for name, _ in played],
        "returns": [value for _, value in played],
        "rows": list(rows),
        "padding_rows": padding_rows,
        "denominator": denominator,
        "settings": dict(settings),
    }
