"""Tree attention in one kernel, for accelerators: a packed row in which every token sees its own path.

Nodes are packed parents first, each subtree in one piece. So token j is on the path of token i exactly if
`j <= i < end(j)`, where `end(j)` is the place after the last token below j: one integer per token says it all, and
FlexAttention (Dong et al., 2024) skips every block in which nobody sees anybody. On a CPU, where it has no backward
pass, attention goes node by node (`trainers.tree.attention.tree_attention`).
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch


def subtree_ends(starts: Sequence[int], ends: Sequence[int], paths: Sequence[tuple[int, ...]]) -> list[int]:
    """Per token the place after the last token of the subtree below it.

    Args:
        starts, ends: first and last place (exclusive) of every node's tokens, parents first.
        paths: every node's ancestors, root first.
    """
    last = list(ends)
    for node in reversed(range(len(paths))):
        if paths[node]:
            parent = paths[node][-1]
            last[parent] = max(last[parent], last[node])
    return [last[n] for n, (start, end) in enumerate(zip(starts, ends, strict=True)) for _ in range(start, end)]


def sees(ends: torch.Tensor, positions: torch.Tensor, window: int = 0) -> Callable[..., torch.Tensor]:
    """FlexAttention's mask function: whether the query at place i sees the key at place j.

    Args:
        ends: (N,), of `subtree_ends`.
        positions: (N,), of each token in its own sequence.
        window: most positions a query sees, itself included (0: all).
    """

    def mask(batch: Any, head: Any, i: torch.Tensor, j: torch.Tensor) -> torch.Tensor:
        on_path = (j <= i) & (i < ends[j])
        return on_path & (positions[i] - positions[j] < window) if window else on_path

    return mask


def block_mask(ends: Sequence[int], positions: Sequence[int], window: int, device: torch.device) -> Any:
    """The tree as FlexAttention's block mask; the same for all layers with one window."""
    from torch.nn.attention.flex_attention import create_block_mask

    e, p = torch.tensor(ends, device=device), torch.tensor(positions, device=device)
    return create_block_mask(sees(e, p, window), None, None, len(ends), len(ends), device=str(device))


def flex_tree(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, mask: Any, scaling: float | None) -> torch.Tensor:
    """Attention of q (1, heads, N, size) to k and v (1, kv heads, N, size) under a block mask; shape of q."""
    output: torch.Tensor = _kernel()(q, k, v, block_mask=mask, scale=scaling, enable_gqa=q.shape[1] != k.shape[1])
    return output


@functools.cache
def _kernel() -> Any:
    from torch.nn.attention.flex_attention import flex_attention

    return torch.compile(flex_attention, dynamic=True)  # the number of tokens differs from update to update


@functools.cache
def usable(device: torch.device, dtype: torch.dtype) -> bool:
    """Whether the kernel compiles and runs here, forward and backward; tried once. A CPU never does."""
    if device.type == "cpu":
        return False
    try:
        q, k, v = (torch.randn(1, h, 160, 64, device=device, dtype=dtype, requires_grad=True) for h in (4, 2, 2))
        flex_tree(q, k, v, block_mask([160] * 160, range(160), 0, device), None).sum().backward()
    except Exception as error:  # whatever a compiler raises
        warnings.warn(f"FlexAttention does not run on {device} ({error}); attention goes node by node", stacklevel=2)
        return False
    return True
