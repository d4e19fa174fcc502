"""Attention along each node's path, registered with transformers as one more attention function.

An ordinary forward falls through to SDPA.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from agentspec.registry import SpecError
from trainers.tree.flex import flex_tree, usable
from trainers.tree.paths import knows, path_attention
from trainers.tree.trie import Tree

ATTENTION = "agentspec_tree"


def register(base: Any) -> None:
    """Make the tree attention known to transformers and to every config of `base`."""
    from transformers.masking_utils import ALL_MASK_ATTENTION_FUNCTIONS, sdpa_mask
    from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS

    if ATTENTION not in ALL_ATTENTION_FUNCTIONS:
        ALL_ATTENTION_FUNCTIONS.register(ATTENTION, tree_attention)
        ALL_MASK_ATTENTION_FUNCTIONS.register(ATTENTION, sdpa_mask)
    for module in base.modules():
        config: Any = getattr(module, "config", None)
        if hasattr(config, "_attn_implementation_internal"):
            config._attn_implementation_internal = ATTENTION


def tree_attention(
    module: nn.Module,
    query: torch.Tensor,
    key: torch.Tensor,
    value: torch.Tensor,
    attention_mask: torch.Tensor | None = None,
    scaling: float | None = None,
    sliding_window: int | None = None,
    tree: Tree | None = None,
    asked: torch.Tensor | None = None,
    **kwargs: Any,
) -> tuple[torch.Tensor, None]:
    """Attention along each node's path; ``asked``: the places (sorted) where it is read, if not everywhere.

    `query` (1, heads, N, size), `key` and `value` (1, kv heads, N, size); returns (1, N, heads, size). Without a
    tree this is transformers' SDPA. With one: node by node on a CPU (`trainers.tree.paths`), one kernel
    (`trainers.tree.flex`) elsewhere.
    """
    if tree is None:
        from transformers.integrations.sdpa_attention import sdpa_attention_forward

        output, _ = sdpa_attention_forward(
            module, query, key, value, attention_mask, scaling=scaling, sliding_window=sliding_window, **kwargs
        )
        return output, None
    if kwargs.get("softcap") is not None or kwargs.get("s_aux") is not None:
        raise SpecError("tree packing does not know soft-capped attention or sinks; set `packing: padded`")
    if usable(query.device, query.dtype):
        mask = tree.block_mask(sliding_window or 0, query.device)
        return flex_tree(query, key, value, mask, scaling).transpose(1, 2), None
    if knows(query, key, value):
        return path_attention(query, key, value, tree, scaling, sliding_window or 0, asked), None
    # One split per tensor: its backward is one concatenation, where slices would each allocate a full gradient.
    queries = query.split(tree.lengths, dim=2)
    keys, values = key.split(tree.lengths, dim=2), value.split(tree.lengths, dim=2)
    outputs = []
    for i, node in enumerate(tree.nodes):
        k = torch.cat([keys[a] for a in node.path] + [keys[i]], dim=2) if node.path else keys[i]
        v = torch.cat([values[a] for a in node.path] + [values[i]], dim=2) if node.path else values[i]
        outputs.append(_path_attention(queries[i], k, v, tree, scaling, sliding_window or 0))
    return torch.cat(outputs, dim=2).transpose(1, 2), None


def _path_attention(
    q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, tree: Tree, scaling: float | None, window: int
) -> torch.Tensor:
    """Causal attention of the last n of L positions: q (1, heads, n, size), k and v (1, kv heads, L, size)."""
    n, length = q.shape[2], k.shape[2]
    grouped = q.shape[1] != k.shape[1]
    if n == length and not 0 < window < length:
        return F.scaled_dot_product_attention(q, k, v, is_causal=True, scale=scaling, enable_gqa=grouped)
    mask = None if n == 1 and not 0 < window < length else _mask(tree, n, length, window, q)
    return F.scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=scaling, enable_gqa=grouped)


def _mask(tree: Tree, n: int, length: int, window: int, like: torch.Tensor) -> torch.Tensor:
    """Additive (n, L) mask of the last n positions, built once per shape and update."""
    key = (n, length, window, like.dtype, like.device)
    if key not in tree.masks:
        here = torch.arange(length - n, length, device=like.device)[:, None]
        there = torch.arange(length, device=like.device)[None]
        hidden = there > here
        if window:
            hidden |= there <= here - window
        tree.masks[key] = torch.zeros(n, length, dtype=like.dtype, device=like.device).masked_fill_(hidden, -torch.inf)
    mask: torch.Tensor = tree.masks[key]
    return mask
