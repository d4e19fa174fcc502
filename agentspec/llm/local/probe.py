"""Whether a model's logits are batch-invariant on this machine: found out, once per process, by reading texts twice.

A text of 1,100 tokens (past the attention kernel's first and second block of keys) is read whole, and again in pieces
of all sizes from 1 to 300 beside other texts; then another with other pieces. Logits in several places and all keys
and values must agree to the last bit. Only as many of the model's first layers run as it takes to see one of each kind
(at least two), so the cost is that of reading some 4,000 tokens with two layers: 0.6 s for SmolLM2-135M on one core.

The answer belongs to shapes, float types, module types and the number of threads, not to weights; it is kept for all
models that agree in these.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from agentspec.llm.local.attention import Segment
from agentspec.llm.local.cache import Slot

if TYPE_CHECKING:
    from agentspec.llm.local.forward import PackedModel

_CUTS = ((130, 642, 1100), (300,))
"""Per text, where the forwards end that read it whole; in the longer one they cross both ends of blocks of keys."""
_PIECES = (1, 1, 2, 3, 5, 7, 16, 17, 33, 100, 300)
_BESIDE = (0, 0, 1, 4)
_LOGITS = 16
"""Logits compared before each cut: those of all tokens would cost more than the layers do."""
_MIN_LAYERS = 2

_KNOWN: dict[Any, bool] = {}


def is_batch_invariant(model: PackedModel) -> bool:
    """Whether `model` gives a token the same logits, keys and values, bit for bit, in whatever forward it is read."""
    found = _KNOWN.get(signature := (str(model.config), model.last_blocks, _signature(model.model)))
    if found is None:
        with model.session(), model.adapter(""), _first_layers(model) as layers:
            found = all(_agrees(model, cuts, seed, layers) for seed, cuts in enumerate(_CUTS))
        _KNOWN[signature] = found
    return found


def _agrees(model: PackedModel, cuts: Sequence[int], seed: int, layers: int) -> bool:
    draw = random.Random(seed)
    vocabulary = int(model.model.get_input_embeddings().weight.shape[0])
    cuts = [cut for cut in cuts if cut <= model.max_context] or [model.max_context]
    text, other = ([draw.randrange(vocabulary) for _ in range(cuts[-1])] for _ in range(2))
    whole, pieces, beside = (Slot(model.layers, len(text)) for _ in range(3))
    start = strange = 0
    for cut in cuts:
        known = start
        (expected,) = model.forward([Segment(whole, text[start:cut], start, _LOGITS)])
        got = []
        while known < cut:
            stop = min(known + draw.choice(_PIECES), cut)
            n = min(draw.choice(_BESIDE), len(other) - strange)
            others = [Segment(beside, other[strange : strange + n], strange, 0)] if n else []
            wanted = max(0, stop - max(known, cut - _LOGITS))
            got.append(model.forward([*others, Segment(pieces, text[known:stop], known, wanted)])[-1])
            known, strange = stop, strange + n
        if not torch.equal(torch.cat(got), expected):
            return False
        start = cut
    pairs = [pair for i in range(layers) for pair in zip(whole.layer(i), pieces.layer(i), strict=True)]
    return all(torch.equal(a[:, : len(text)], b[:, : len(text)]) for a, b in pairs)


@contextmanager
def _first_layers(model: PackedModel) -> Iterator[int]:
    """The model runs only its first layers inside, as many as show one of each kind; yields their number."""
    text = model.text_config
    stack = decoder_layers(model.model, model.layers)
    if stack is None:
        yield model.layers
        return
    types: Sequence[str] = getattr(text, "layer_types", None) or [""] * model.layers
    kinds = [(kind, _signature(layer)) for kind, layer in zip(types, stack, strict=True)]
    count = max(_MIN_LAYERS, max(kinds.index(kind) for kind in kinds) + 1)
    count = min(count, model.layers)
    text.num_hidden_layers = count
    try:
        yield count
    finally:
        text.num_hidden_layers = model.layers


def decoder_layers(model: nn.Module, count: int) -> nn.ModuleList | None:
    """The stack of decoder layers, in models that run `layers[:config.num_hidden_layers]`."""
    stacks = [m for name, m in model.named_modules() if name.endswith(".layers") and isinstance(m, nn.ModuleList)]
    return next((m for m in stacks if len(m) == count), None)


def _signature(model: nn.Module) -> Any:
    """What the arithmetic of a model depends on besides its weights."""
    modules = tuple((type(m), bool(m._forward_hooks or m._forward_pre_hooks)) for m in model.modules())
    weights = tuple((tuple(p.shape), p.dtype, p.device) for p in model.parameters())
    return modules, weights, torch.get_num_threads(), torch.get_float32_matmul_precision()
