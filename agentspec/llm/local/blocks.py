"""How many keys attention reads: as few as give the bits that whole blocks give.

torch's attention kernel takes keys in blocks of 512 and multiplies the weights and values of a block in one product. If
every block is whole and keys to come are hidden, a token's bits cannot depend on how many keys there are; and on
average a quarter of a thousand keys are read for nothing. A last block may be shorter where its product is summed in
the same pieces. MKL picks the pieces by length (on an AMD EPYC, 256 and 320 are one piece, 384 and more pieces of
192), so which lengths do is tried out.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch.nn.functional import pad, scaled_dot_product_attention

WHOLE = 512
"""Keys that torch's kernel takes at a time on a CPU."""
STEP = 64
"""Lengths of a last block are multiples of this."""
_ROWS = (4, 32, 96)
"""Queries that the kernel is tried with: the fewest, one block of queries and several."""


def padded(total: int, last: Sequence[int]) -> int:
    """Keys to read so that the first ``total`` are among them; ``last`` as from `last_blocks`.

    >>> padded(100, (512,)), padded(100, (64, 128, 512)), padded(513, (64, 128, 512)), padded(700, (64, 512))
    (512, 128, 576, 1024)
    """
    rest = (total - 1) % WHOLE + 1
    return total - rest + next(n for n in last if n >= rest)


@lru_cache
def last_blocks(size: int, threads: int) -> tuple[int, ...]:
    """The lengths of a last block, `WHOLE` among them, that give float32 heads of ``size`` the same bits.

    ``threads`` is how many torch computes with now.
    """
    draw = torch.Generator().manual_seed(0)
    keys, values = (torch.randn(1, 2, WHOLE, size, generator=draw) for _ in range(2))
    queries = torch.randn(1, 2, max(_ROWS), size, generator=draw)
    return (*(n for n in range(STEP, WHOLE, STEP) if _same(queries, keys, values, n)), WHOLE)


def _same(queries: torch.Tensor, keys: torch.Tensor, values: torch.Tensor, n: int) -> bool:
    for rows in _ROWS:
        for known in (n, n - STEP // 2 - 1):
            mask = torch.zeros(rows, n)
            mask[:, known:] = float("-inf")
            whole = pad(mask, (0, WHOLE - n), value=float("-inf"))
            q = queries[:, :, :rows]
            short = scaled_dot_product_attention(q, keys[:, :, :n], values[:, :, :n], attn_mask=mask)
            if not torch.equal(short, scaled_dot_product_attention(q, keys, values, attn_mask=whole)):
                return False
    return True
