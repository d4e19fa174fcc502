"""Rows -> micro-batches.

The number of micro-batches is fixed by the configuration; the number of rows is not. Rows are partitioned so that every
micro-batch holds the same number of rows (short of one), none is empty while there are rows enough, and what is missing
is padded with rows that train nothing. So no row is ever lost and the number of optimiser steps never depends on the
scaffold.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch.nn.utils.rnn import pad_sequence

from trainers.sequences import Advantage, Row, TokenSequence

ROWS = "rows"
"""Key under which a micro-batch carries its rows beside the tensors that TRL reads."""
PADDED = "padded"
"""Key of the round's number of rows with padding over that without, all ranks together."""


def padding_row(token: int) -> Row:
    """A row of two tokens that trains nothing."""
    sequence = TokenSequence()
    sequence.extend_context([token, token])
    return Row(sequence, 0.0, -1)


def partition(
    rows: Sequence[Row], count: int, *, padding: Row, size: int = 0, by_prefix: bool = False
) -> list[list[Row]]:
    """`count` micro-batches of equal size.

    Longest first, each row goes to the micro-batch with the fewest tokens that still has room; or, with `by_prefix`,
    rows that share prefixes stay together.

    Args:
        padding: fills what is missing.
        size: rows per micro-batch (0: as few as the rows need); another rank may have more of them.

    Raises:
        ValueError: `size` is too small.
    """
    needed = max(-(-len(rows) // count), 1)
    if size and size < needed:
        raise ValueError(f"{len(rows)} rows do not fit into {count} micro-batches of {size}")
    parts: list[list[Row]] = [[] for _ in range(count)]
    if by_prefix:
        ordered = sorted(rows, key=lambda r: r.sequence.tokens)
        bounds = [i * len(rows) // count for i in range(count + 1)]
        parts = [ordered[start:stop] for start, stop in pairwise(bounds)]
    else:
        tokens = [0] * count
        for row in sorted(rows, key=lambda r: -len(r.sequence)):
            place = min((i for i in range(count) if len(parts[i]) < needed), key=lambda i: (tokens[i], i))
            parts[place].append(row)
            tokens[place] += len(row.sequence)
    return [part + [padding] * (max(size, needed) - len(part)) for part in parts]


def collate(rows: Sequence[Row], pad: int, device: torch.device | str = "cpu") -> dict[str, torch.Tensor]:
    """The tensors TRL's loss reads, right-padded; the first token stands as the prompt, all others as completion.

    Shapes with B rows of at most L tokens: `prompt_ids`, `prompt_mask` (B, 1); `completion_ids`, `completion_mask`,
    `tool_mask` and `sampled_logprobs` (B, L-1); `advantages` (B,) or, if any row has one per token, (B, L-1).
    """
    sequences = [r.sequence for r in rows]
    ids = _padded([s.tokens for s in sequences], torch.long, pad)
    attention = _padded([[1] * len(s) for s in sequences], torch.long)
    mask = _padded([s.mask for s in sequences], torch.long)
    logprobs = _padded([s.logprobs for s in sequences])
    per_token = any(not isinstance(r.advantage, (int, float)) for r in rows)
    advantages = _padded([_each(r.advantage, len(r.sequence) if per_token else 1) for r in rows])
    batch = {
        "prompt_ids": ids[:, :1],
        "prompt_mask": attention[:, :1],
        "completion_ids": ids[:, 1:],
        "completion_mask": attention[:, 1:],
        "tool_mask": mask[:, 1:],
        "sampled_logprobs": logprobs[:, 1:],
        "advantages": advantages[:, 1:] if per_token else advantages[:, 0],
    }
    return {name: tensor.to(device) for name, tensor in batch.items()}


def _padded(lists: Sequence[Sequence[float]], dtype: torch.dtype = torch.float32, pad: int = 0) -> torch.Tensor:
    return pad_sequence([torch.tensor(v, dtype=dtype) for v in lists], batch_first=True, padding_value=pad)


def _each(advantage: Advantage, count: int) -> Sequence[float]:
    """One per token, where the row has one number for all."""
    return [advantage] * count if isinstance(advantage, (int, float)) else advantage
