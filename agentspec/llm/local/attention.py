"""Attention of many sequences in one row of tokens: each segment of new tokens sees its own sequence only.

This is what the packed forward (`agentspec.llm.local.forward`) puts in the place of a model's attention. A
segment's new keys and values are stored in its slot, and its queries attend to the slot. The query heads that share a
key-value head are laid side by side as more queries of that head, so that keys and values are read once and never
repeated.

On a CPU segments go one by one, each against blocks of keys of which those to come are hidden
(`agentspec.llm.local.blocks`): then the order in which a token's keys are summed up depends on its position alone, not
on how many tokens are read at once. torch's kernel takes queries in blocks of 32 (64, 256 for more), and MKL multiplies
the rows of a last block of fewer than 4 by other kernels: such a block is filled up to 4. And a single head would be
multiplied by all threads together, in pieces that depend on the number of queries: it is given to the kernel as
several. So the same token in the same context is the same, bit for bit, whoever else is in the batch
(`agentspec.llm.local.invariance`). The queries of segments of one token (sequences that are writing) are laid out
together; on an accelerator, where a launch costs more than the work, the keys are too, in one padded batch.
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
from agentspec.llm.local.blocks import padded
from agentspec.llm.local.cache import Slot
from agentspec.llm.local.invariance import MIN_ROWS, elementwise

_ACTIVE = threading.local()
_BATCHED_FROM = {"cpu": 1 << 30}
_BATCHED_FROM_DEFAULT = 4
_QUERIES = {"cpu": 32}
"""Queries that torch's attention kernel takes at a time, or a divisor of them."""


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
    """The segments of one forward, where each lies in the row of tokens, and masks that all layers share.

    ``last`` are the lengths that a last block of keys may have (`agentspec.llm.local.blocks`); empty: any.
    """

    segments: Sequence[Segment]
    bounds: list[tuple[int, int]]
    last: Sequence[int] = ()
    masks: dict[tuple[int, ...], torch.Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        numbers = range(len(self.segments))
        self.single = [i for i in numbers if len(self.segments[i].tokens) == 1 and self.segments[i].source is None]
        together = set(self.single)
        self.others = [i for i in numbers if i not in together]

    def keys(self, total: int) -> int:
        """How many keys to read so that the first ``total`` are among them."""
        return padded(total, self.last) if self.last else total


@dataclass(frozen=True)
class _Scores:
    """How a layer turns queries and keys into weights."""

    scaling: float | None
    window: int
    softcap: float | None
    sinks: torch.Tensor | None


@contextmanager
def active(pack: Pack) -> Iterator[None]:
    """The pack that `packed_attention` works on, in this thread."""
    _ACTIVE.pack = pack
    try:
        yield
    finally:
        _ACTIVE.pack = None


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
    """Attention of the active pack, with the signature transformers calls.

    Args:
        module: the attention layer (its ``layer_idx``).
        query: (1, heads, T, size), rotated; ``key`` and ``value`` (1, key-value heads, T, size).
        scaling, sliding_window, softcap, s_aux: as the model passes them (``s_aux``: attention sinks, one per head).

    Returns:
        Attended values (1, T, heads, size), and no weights.
    """
    pack: Pack | None = getattr(_ACTIVE, "pack", None)
    if pack is None:
        raise LLMError("the model was used by another thread while the local backend sampled from it; take turns")
    layer = int(module.layer_idx)  # type: ignore[arg-type]
    scores = _Scores(scaling, sliding_window or 0, softcap, s_aux)
    out = query.new_empty(1, query.shape[2], query.shape[1], value.shape[-1])
    out[:, pack.bounds[-1][1] :] = 0.0  # padding tokens attend to nothing
    for i in pack.others:
        begin, end = pack.bounds[i]
        segment = pack.segments[i]
        if segment.source is not None and segment.start > segment.known:
            segment.slot.copy_layer(layer, segment.source, segment.known, segment.start)
        segment.slot.write(layer, segment.start, key[0, :, begin:end], value[0, :, begin:end])
        out[0, begin:end] = _several(pack, [segment], layer, query[0, :, begin:end][None], scores)[0]
    if pack.single:
        columns = torch.tensor([pack.bounds[i][0] for i in pack.single], device=query.device)
        segments = [pack.segments[i] for i in pack.single]
        for segment, k, v in zip(segments, key[0][:, columns].unbind(1), value[0][:, columns].unbind(1), strict=True):
            segment.slot.write(layer, segment.start, k[:, None], v[:, None])
        queries = query[0][:, columns].transpose(0, 1)
        if len(segments) < _BATCHED_FROM.get(query.device.type, _BATCHED_FROM_DEFAULT):
            out[0, columns] = _several(pack, segments, layer, queries[:, :, None], scores)[:, 0]
        else:
            out[0, columns] = _batch(pack, segments, layer, queries, scores)
    return out, None


def _several(pack: Pack, segments: Sequence[Segment], layer: int, query: torch.Tensor, scores: _Scores) -> torch.Tensor:
    """The queries (B, heads, n, size) of segments of n tokens, each to its slot in turn; (B, n, heads, size)."""
    size, heads, n = query.shape[:3]
    slots = [s.slot.layer(layer) for s in segments]
    kv_heads = slots[0][0].shape[0]
    if alone := kv_heads == 1 and query.device.type == "cpu":
        kv_heads = max(2, heads)
        query = query.expand(-1, kv_heads, -1, -1)
    groups = max(1, heads // kv_heads)
    rows = _query_rows(groups * n, query.device)
    q = query.reshape(size, kv_heads, groups * n, -1)
    if rows > groups * n:
        q = torch.nn.functional.pad(q, (0, 0, 0, rows - groups * n))
    attended = []
    for i, (segment, slot) in enumerate(zip(segments, slots, strict=True)):
        total = segment.start + n
        read = pack.keys(total)
        k, v = (x[None, :, :read] for x in slot)
        if alone:
            k, v = (x.expand(1, kv_heads, -1, -1) for x in (k, v))
        mask = _causal_mask(pack, n, total, read, groups, rows, scores.window, q)
        attended.append(_attend(q[i : i + 1], k, v, mask, groups, n, scores))
    o = torch.cat(attended)[:, :, : groups * n]
    return o.reshape(size, -1, n, o.shape[-1])[:, :heads].transpose(1, 2)


def _query_rows(rows: int, device: torch.device) -> int:
    """Rows of queries with the last block of the kernel filled up to `MIN_ROWS`."""
    block = _QUERIES.get(device.type, 1)
    last = rows % block
    return rows if last == 0 else rows + max(0, MIN_ROWS - last)


def _batch(pack: Pack, segments: Sequence[Segment], layer: int, query: torch.Tensor, scores: _Scores) -> torch.Tensor:
    """The single queries (heads, B, size) of many segments, each to its slot; (B, heads, size)."""
    totals = [s.start + 1 for s in segments]
    slots = [s.slot.layer(layer) for s in segments]
    longest, (keys, values) = max(totals), slots[0]
    # Zeros, not whatever memory holds: a masked weight of 0 times NaN is NaN.
    k = keys.new_zeros(len(segments), keys.shape[0], longest, keys.shape[2])
    v = values.new_zeros(len(segments), values.shape[0], longest, values.shape[2])
    for batch, known in ((k, [s[0] for s in slots]), (v, [s[1] for s in slots])):
        rows = [batch[i, :, :t] for i, t in enumerate(totals)]
        torch._foreach_copy_(rows, [x[:, :t] for x, t in zip(known, totals, strict=True)])
    groups = query.shape[0] // keys.shape[0]
    q = query.transpose(0, 1).reshape(len(segments), keys.shape[0], groups, -1)
    mask = _padding_mask(pack, totals, scores.window, q)
    return _attend(q, k, v, mask, groups, 1, scores).reshape(len(segments), query.shape[0], -1)


def _causal_mask(
    pack: Pack, n: int, total: int, read: int, groups: int, rows: int, window: int, like: torch.Tensor
) -> torch.Tensor | None:
    """Additive mask (rows, read) of the last ``n`` of ``total`` positions, for ``groups`` times ``n`` queries and
    padding that sees everything; ``None`` if nothing is hidden.
    """
    if n == 1 and read == total and not 0 < window < total:
        return None
    cached = pack.masks.get((n, total, groups, window))
    if cached is None:
        here = torch.arange(total - n, total, device=like.device)[:, None]
        there = torch.arange(read, device=like.device)[None]
        hidden = there > here
        if window:
            hidden |= there <= here - window
        mask = torch.zeros(rows, read, dtype=like.dtype, device=like.device)
        mask[: groups * n].masked_fill_(hidden.repeat(groups, 1), float("-inf"))
        cached = pack.masks[n, total, groups, window] = mask
    return cached


def _padding_mask(pack: Pack, totals: Sequence[int], window: int, like: torch.Tensor) -> torch.Tensor:
    """Additive mask (B, 1, 1, longest) of the last of each row's ``totals`` positions."""
    cached = pack.masks.get((window,))
    if cached is None:
        ends = torch.tensor(totals, device=like.device)[:, None]
        there = torch.arange(max(totals), device=like.device)[None]
        hidden = there >= ends
        if window:
            hidden |= there < ends - window
        mask = torch.zeros(hidden.shape, dtype=like.dtype, device=like.device).masked_fill_(hidden, float("-inf"))
        cached = pack.masks[(window,)] = mask[:, None, None]
    return cached


def _attend(
    q: torch.Tensor,
    k: torch.Tensor,
    v: torch.Tensor,
    mask: torch.Tensor | None,
    groups: int,
    n: int,
    scores: _Scores,
) -> torch.Tensor:
    """Attention of (B, key-value heads, groups * n and padding, size) queries, written out where the fused kernel
    lacks something.
    """
    if scores.softcap is None and scores.sinks is None:
        return scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=scores.scaling)
    weights = torch.matmul(q, k.transpose(-1, -2)).float()
    weights = weights * (q.shape[-1] ** -0.5 if scores.scaling is None else scores.scaling)
    if scores.softcap is not None:
        weights = elementwise(torch.tanh, weights / scores.softcap) * scores.softcap
    if mask is not None:
        weights = weights + mask.float()
    if scores.sinks is not None:
        sinks = scores.sinks.float().reshape(1, -1, groups, 1).repeat_interleave(n, dim=2)
        padding = sinks.new_zeros(1, sinks.shape[1], q.shape[2] - sinks.shape[2], 1)
        sinks = torch.cat([sinks, padding], 2).expand(q.shape[0], q.shape[1], -1, -1)
        weights = torch.cat([weights, sinks], dim=-1)
    return torch.matmul(weights.softmax(-1)[..., : k.shape[2]].to(v.dtype), v)
