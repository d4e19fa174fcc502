"""Attention of many sequences in one row of tokens: each segment of new tokens sees its own sequence only.

This is what the packed forward (:mod:`agentspec.llm.local_forward`) puts in the place of a model's attention. A segment's
new keys and values are stored in its slot, and its queries attend to the slot. The query heads that share a key-value head
are laid side by side as more queries of that head, so that keys and values are read once and never repeated.

On a CPU segments go one by one. On an accelerator, where a launch costs more than the work, the segments of one token
(sequences that are writing) are gathered into one padded batch.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch.nn.functional import scaled_dot_product_attention

from agentspec.llm.base import LLMError
from agentspec.llm.local_cache import Slot

_ACTIVE = threading.local()
_BATCHED_FROM = {"cpu": 1 << 30}
_BATCHED_FROM_DEFAULT = 4


@dataclass
class Segment:
    """Consecutive new tokens of one sequence.

    Args:
        slot: where the keys and values of the sequence are; its first ``start`` positions are known.
        tokens: ids at positions ``start ...``.
        start: position of the first of ``tokens``.
        logits: number of last positions whose logits are wanted (0: none).
        source: another slot that holds the same tokens up to ``start``; positions from ``known`` on are copied from it
            while the batch runs (it may be filled by an earlier segment of the same batch).
        known: number of positions the slot itself already holds.
    """

    slot: Slot
    tokens: Sequence[int]
    start: int
    logits: int = 1
    source: Slot | None = None
    known: int = 0


@dataclass
class Pack:
    segments: Sequence[Segment]
    bounds: list[tuple[int, int]]
    masks: dict[tuple[int, int, int, int], torch.Tensor] = field(default_factory=dict)


def packed_attention(
    module: torch.nn.Module,
    query: torch.Tensor,
    key: torch.Tensor,
    value: torch.Tensor,
    attention_mask: torch.Tensor | None = None,
    scaling: float | None = None,
    sliding_window: int | None = None,
    softcap: float | None = None,
    s_aux: torch.Tensor | None = None,
    **_: Any,
) -> tuple[torch.Tensor, None]:
    """Attention of the active pack: ``query`` (1, heads, T, size) to each segment's own slot; (1, T, heads, size)."""
    pack: _Pack | None = getattr(_ACTIVE, "pack", None)
    if pack is None:
        raise LLMError("the model was used by another thread while the local backend sampled from it; take turns")
    layer = int(module.layer_idx)  # type: ignore[arg-type]
    heads, kv_heads = query.shape[1], key.shape[1]
    groups = heads // kv_heads
    out = query.new_empty(1, query.shape[2], heads, value.shape[-1])
    for segment, (begin, end) in zip(pack.segments, pack.bounds, strict=True):
        slot, n = segment.slot, end - begin
        if segment.source is not None and segment.start > segment.known:
            slot.copy_layer(layer, segment.source, segment.known, segment.start)
        slot.write(layer, segment.start, key[0, :, begin:end], value[0, :, begin:end])
        total = segment.start + n
        keys, values = slot.keys[layer], slot.values[layer]
        assert keys is not None and values is not None
        # Query heads of one key-value head are laid side by side as more queries: keys are read once, never repeated.
        q = query[:, :, begin:end].reshape(1, kv_heads, groups * n, -1)
        k, v = keys[None, :, :total], values[None, :, :total]
        mask = _mask(pack, n, total, groups, sliding_window or 0, q)
        if softcap is None and s_aux is None:
            o = scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=scaling)
        else:
            o = _attend(q, k, v, mask, scaling, softcap, s_aux)
        out[0, begin:end] = o.reshape(heads, n, -1).transpose(0, 1)
    return out, None


def _mask(pack: _Pack, n: int, total: int, groups: int, window: int, like: torch.Tensor) -> torch.Tensor | None:
    """Additive mask (groups * n, total) of the last ``n`` of ``total`` positions; ``None`` if nothing is hidden."""
    if n == 1 and not 0 < window < total:
        return None
    cached = pack.masks.get((n, total, groups, window))
    if cached is None:
        here = torch.arange(total - n, total, device=like.device)[:, None]
        there = torch.arange(total, device=like.device)[None]
        hidden = there > here
        if window:
            hidden |= there <= here - window
        cached = torch.zeros(n, total, dtype=like.dtype, device=like.device).masked_fill_(hidden, float("-inf"))
        cached = pack.masks[n, total, groups, window] = cached.repeat(groups, 1)
    return cached


def _attend(
    q: torch.Tensor,
    k: torch.Tensor,
    v: torch.Tensor,
    mask: torch.Tensor | None,
    scaling: float | None,
    softcap: float | None,
    sinks: torch.Tensor | None,
) -> torch.Tensor:
    """Attention written out, for what the fused kernel lacks: soft-capped scores, and attention sinks (one per
    head)."""
    scores = torch.matmul(q, k.transpose(-1, -2)).float() * (q.shape[-1] ** -0.5 if scaling is None else scaling)
    if softcap is not None:
        scores = torch.tanh(scores / softcap) * softcap
    if mask is not None:
        scores = scores + mask.float()
    if sinks is not None:
        per_query = (
            sinks.float()
            .reshape(1, k.shape[1], -1, 1)
            .repeat_interleave(q.shape[2] // (sinks.numel() // k.shape[1]), dim=2)
        )
        scores = torch.cat([scores, per_query], dim=-1)
    weights = scores.softmax(-1)[..., : k.shape[2]]
    return torch.matmul(weights.to(v.dtype), v)
