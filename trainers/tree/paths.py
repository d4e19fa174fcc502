"""Tree attention on a CPU: torch's own kernel and its gradient, called once for each node.

Under autograd a node's keys and values would be copied together, repeated for every query head that shares them, and
their gradients copied apart. Here a path that stands in one piece is read where it is, the query heads that share a
key-value head are laid side by side as more queries of it, and gradients are added up in place. The queries of a head
are shared out so that all threads have as many products.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch

from trainers.tree.trie import Tree

_LEAST = 32
"""Queries that torch's kernel takes at a time, at least: they are not shared out in smaller parts."""


class _Part(NamedTuple):
    """A node's queries: where they are, what they see, and the mask of that, (shares, kv heads, rows, L)."""

    rows: Any  # slice or (n,) places
    n: int
    spans: list[tuple[int, int]]
    shares: int
    mask: torch.Tensor


def knows(query: torch.Tensor, key: torch.Tensor, value: torch.Tensor) -> bool:
    """Whether torch's kernel for CPUs computes this attention: heads of one size and type (autocast may mix them)."""
    known = hasattr(torch.ops.aten, "_scaled_dot_product_flash_attention_for_cpu_backward")
    alike = query.dtype == key.dtype == value.dtype and query.shape[-1] == value.shape[-1]
    return known and alike and query.device.type == "cpu" and query.shape[2] > 0


def path_attention(
    query: torch.Tensor,
    key: torch.Tensor,
    value: torch.Tensor,
    tree: Tree,
    scaling: float | None,
    window: int,
    asked: torch.Tensor | None = None,
) -> torch.Tensor:
    """Attention of `query` (1, heads, N, size) to `key` and `value` (1, kv heads, N, size): (1, N, heads, size).

    Args:
        window: most positions a query sees, itself included (0: all).
        asked: sorted places that are computed, zeros elsewhere (default: all).
    """
    out: torch.Tensor = _Paths.apply(query, key, value, tree, scaling, window, asked)
    return out


class _Paths(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, query: Any, key: Any, value: Any, tree: Tree, scaling: Any, window: int, asked: Any) -> Any:
        kernel = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
        query, key, value = (x if x.stride(-1) == 1 else x.contiguous() for x in (query, key, value))
        _, heads, count, size = query.shape
        out = (torch.empty if asked is None else torch.zeros)(1, count, heads, size, dtype=query.dtype)
        sums = []
        for part in _parts(tree, query, key.shape[1], window, asked):
            q, (k, v) = _queries(query, part, key.shape[1]), (_seen(x, part) for x in (key, value))
            attended, logsumexp = kernel(q, k, v, 0.0, False, attn_mask=part.mask, scale=scaling)
            out[0, part.rows] = _apart(attended, part)
            sums.append(logsumexp)
        ctx.save_for_backward(query, key, value, out, *sums)
        ctx.how = tree, scaling, window, asked
        return out

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> Any:
        kernel = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward
        query, key, value, out, *sums = ctx.saved_tensors
        tree, scaling, window, asked = ctx.how
        of_query, of_key, of_value = (torch.zeros_like(x) for x in (query, key, value))
        gradient, out = (x.transpose(1, 2) for x in (gradient, out))
        parts = _parts(tree, query, key.shape[1], window, asked)
        for part, logsumexp in zip(parts, sums, strict=True):
            g, q, attended = (_queries(x, part, key.shape[1]) for x in (gradient, query, out))
            k, v = (_seen(x, part) for x in (key, value))
            of_q, of_k, of_v = kernel(g, q, k, v, attended, logsumexp, 0.0, False, attn_mask=part.mask, scale=scaling)
            of_query[0, :, part.rows] = _apart(of_q, part).transpose(0, 1)
            for total, new in ((of_key, of_k), (of_value, of_v)):
                pieces = new.split([end - start for start, end in part.spans], dim=2)
                for (start, end), piece in zip(part.spans, pieces, strict=True):
                    for share in piece:
                        total[0, :, start:end] += share
        return of_query, of_key, of_value, None, None, None, None


def _parts(tree: Tree, query: torch.Tensor, kv_heads: int, window: int, asked: torch.Tensor | None) -> Iterator[_Part]:
    """Per node its queries, or those `asked` of them."""
    groups, threads = query.shape[1] // kv_heads, torch.get_num_threads()
    even = threads // math.gcd(threads, kv_heads)
    masks = _masks(tree, groups, window, query.dtype)
    for node, spans in zip(tree.nodes, tree.spans, strict=True):
        n = node.end - node.start
        rows: Any = slice(node.start, node.end)
        mask = masks[:, masks.shape[1] - n :, masks.shape[2] - sum(end - start for start, end in spans) :]
        if asked is not None:
            rows = asked[(asked >= node.start) & (asked < node.end)]
            mask, n = mask[:, rows - node.start], len(rows)
        if n:
            shares = even if (groups * n) % even == 0 and groups * n >= _LEAST * even else 1
            yield _Part(
                rows, n, spans, shares, mask.flatten(0, 1).unflatten(0, (shares, 1, -1)).expand(-1, kv_heads, -1, -1)
            )


def _masks(tree: Tree, groups: int, window: int, dtype: torch.dtype) -> torch.Tensor:
    """Additive mask (groups, n, L) of the last n of L positions, for the longest node and path of the tree.

    What a query sees hangs on its distance to the end: that of fewer queries or positions is the last of its rows and
    columns.
    """
    key = ("paths", groups, window, dtype)
    if key not in tree.masks:
        n, longest = max(tree.lengths), 1 + max(tree.positions)
        here, there = torch.arange(longest - n, longest)[:, None], torch.arange(longest)[None]
        hidden = there > here
        if window:
            hidden |= there <= here - window
        mask = torch.zeros(n, longest, dtype=dtype).masked_fill_(hidden, -torch.inf)
        tree.masks[key] = mask.repeat(groups, 1, 1)
    masks: torch.Tensor = tree.masks[key]
    return masks


def _queries(x: torch.Tensor, part: _Part, kv_heads: int) -> torch.Tensor:
    """Of x (1, heads, N, size) the part's rows: (shares, kv heads, rows, size)."""
    rows = x[0, :, part.rows].reshape(kv_heads, part.shares, -1, x.shape[-1])
    return rows.transpose(0, 1)


def _apart(x: torch.Tensor, part: _Part) -> torch.Tensor:
    """`_queries` undone: (n, heads, size)."""
    return x.transpose(0, 1).reshape(-1, part.n, x.shape[-1]).transpose(0, 1)


def _seen(x: torch.Tensor, part: _Part) -> torch.Tensor:
    """Of x (1, kv heads, N, size) what the part sees: (shares, kv heads, L, size)."""
    pieces = [x[:, :, start:end] for start, end in part.spans]
    seen = pieces[0] if len(pieces) == 1 else torch.cat(pieces, dim=2)
    return seen.expand(part.shares, -1, -1, -1)
