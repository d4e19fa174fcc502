"""Log-probabilities of a micro-batch: padded rows or a prefix tree, in one forward or in several within a token budget.

Every trained token is computed. Rows without a policy gradient may be computed without a graph: their log-probabilities
and entropies are in the figures of the update, but they cost no backward pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any, Literal

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.checkpoint import checkpoint

from agentspec.tokens import shared_prefix
from trainers.frozen import LIMIT, FrozenOutput, language_model, output_of
from trainers.logprobs import sampled_logprobs
from trainers.lora import merged_lora
from trainers.micro_batches import padding_row
from trainers.sequences import Row, TokenSequence
from trainers.tree.model import Wanted, packed_inputs
from trainers.tree.trie import build_tree

Packing = Literal["tree", "padded"]
Places = Sequence[tuple[int, int]]
Recorded = Callable[[Sequence[int]], torch.Tensor | None]
"""Tokens -> what came out of the frozen layers when the rollouts read them, (n, hidden), if that is known."""
FROZEN_TOKENS = 8192
"""Tokens whose frozen output is computed in one forward of a tree, where no other budget is set."""


def rows_logprobs(
    model: nn.Module,
    rows: Sequence[Row],
    *,
    skip_backward: bool = False,
    packing: Packing = "padded",
    tokens_per_forward: int = 0,
    frozen: FrozenOutput | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probabilities and entropies of all trained tokens of a micro-batch.

    Logits are computed only where a token is trained. Untrained places hold 0.

    Args:
        skip_backward: compute rows without a policy gradient without a graph.
        packing: `padded` rows, or a prefix `tree` (the model must know it: `trainers.tree.model.enable_tree`).
        tokens_per_forward: token budget of a forward (0: no bound for a tree, one row for padded ones). If one forward
            does not hold the micro-batch, forwards are recomputed in the backward pass, so that activations of one
            chunk at a time are kept.
        frozen: forwards of rows that it knows start above the model's frozen layers.

    Returns:
        two float32 tensors of shape (B, L-1), aligned with `completion_ids` of `trainers.micro_batches.collate`.
    """
    trained = [i for i, r in enumerate(rows) if r.sequence.trained]
    still = [i for i in trained if skip_backward and rows[i].zero_gradient]
    live = [i for i in trained if i not in set(still)]
    forward = partial(_forward, packing=packing, frozen=frozen)
    chunks = list(_chunks(rows, live, packing, tokens_per_forward))
    recompute = packing == "tree" and len(chunks) > 1 and torch.is_grad_enabled()
    # DDP arms its gradient reduction in forward, once per backward: the first forward is its own and is not repeated
    # in the backward pass; the others go to the module inside.
    replicated = isinstance(model, DistributedDataParallel)
    inner: Any = model.module if replicated else model
    logps, entropies = _computed(forward, model, inner, rows, chunks, recompute=recompute)
    if not live:
        # Every rank takes part in the forward and the backward pass, with or without something to learn: otherwise
        # the others would wait for its gradients.
        logps = logps + 0.0 * forward(model, [padding_row(0).sequence], [(0, 1)], logps.device)[0].sum()
    if still:
        with torch.no_grad():
            chunks = list(_chunks(rows, still, packing, tokens_per_forward))
            more = _computed(forward, inner, inner, rows, chunks)
        logps, entropies = logps + more[0], entropies + more[1]
    return logps, entropies


def _computed(
    forward: Callable[..., tuple[torch.Tensor, torch.Tensor]],
    model: nn.Module,
    inner: nn.Module,
    rows: Sequence[Row],
    chunks: Sequence[Sequence[int]],
    *,
    recompute: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Values of the rows in `chunks`, one forward each; 0 elsewhere. The first goes to `model`, others to `inner`."""
    device = next(model.parameters()).device
    length = max(len(r.sequence) for r in rows)
    logps = torch.zeros(len(rows), length - 1, device=device)
    entropies = torch.zeros(len(rows), length - 1, device=device)
    for number, chunk in enumerate(chunks):
        sequences = [rows[i].sequence for i in chunk]
        places = [(i, p) for i, s in enumerate(sequences) for p, m in enumerate(s.mask) if m]
        first = model is not inner and number == 0
        if recompute and not first:
            logp, entropy = checkpoint(forward, inner, sequences, places, device, use_reentrant=False)
        else:
            logp, entropy = forward(model if first else inner, sequences, places, device)
        index = (
            torch.tensor([chunk[r] for r, _ in places], device=device),
            torch.tensor([p - 1 for _, p in places], device=device),
        )
        logps = logps.index_put(index, logp)
        entropies = entropies.index_put(index, entropy.detach())
    return logps, entropies


def _chunks(rows: Sequence[Row], todo: list[int], packing: Packing, budget: int) -> Iterator[list[int]]:
    """Rows of one forward each: within the token budget (unique tokens for a tree, padded ones otherwise)."""
    if packing == "tree":
        todo = sorted(todo, key=lambda i: rows[i].sequence.tokens)
    elif budget:
        todo = sorted(todo, key=lambda i: len(rows[i].sequence))
    chunk: list[int] = []
    used = 0
    for i in todo:
        length = len(rows[i].sequence)
        if packing == "tree":
            shared = shared_prefix(rows[chunk[-1]].sequence.tokens, rows[i].sequence.tokens) if chunk else 0
            cost, full = length - shared, bool(budget) and used + length - shared > budget
        else:
            cost, full = length, (len(chunk) + 1) * length > budget
        if chunk and full:
            yield chunk
            chunk, used, cost = [], 0, length
        chunk.append(i)
        used += cost
    if chunk:
        yield chunk


def _forward(
    model: nn.Module,
    sequences: Sequence[TokenSequence],
    places: Places,
    device: torch.device,
    *,
    packing: Packing,
    frozen: FrozenOutput | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probability and entropy of every place, from one forward."""
    inputs, packed = _packed(packing, _read(sequences, places), device)
    count, length = inputs["input_ids"].shape
    before = torch.tensor([packed[r][p - 1] for r, p in places], device=device)
    wanted = Wanted(
        before,
        torch.tensor([sequences[r].tokens[p] for r, p in places], device=device),
        torch.tensor([sequences[r].temperatures[p] for r, p in places], device=device),
        tuple(sequences[r].allowed.get(p) for r, p in places),
    )
    started = frozen.given(sequences, packed, (count, length)) if frozen else nullcontext()
    with merged_lora(model), started:
        if packing == "tree":
            output = model(**inputs, wanted=wanted)
            return output.log_probs, output.entropies
        # Only positions that some row trains are projected on the vocabulary.
        keep, column = (before % length).unique(return_inverse=True)
        logits = model(**inputs, logits_to_keep=keep, use_cache=False).logits[before // length, column]
    return sampled_logprobs(logits, wanted.tokens, wanted.temperatures, wanted.allowed)


def _read(sequences: Sequence[TokenSequence], places: Places) -> list[list[int]]:
    """Of each sequence the tokens that something is predicted from: those before its last place."""
    ends = [0] * len(sequences)
    for r, p in places:
        ends[r] = max(ends[r], p)
    return [s.tokens[:end] for s, end in zip(sequences, ends, strict=True)]


def _packed(
    packing: Packing, tokens: Sequence[list[int]], device: torch.device
) -> tuple[dict[str, Any], Sequence[Sequence[int]]]:
    """Inputs (B, L) of one forward, a prefix tree or rows padded right; where, flattened, each list's tokens are."""
    if packing == "tree":
        tree = build_tree(tokens)
        return packed_inputs(tree, device), tree.places
    length = max(map(len, tokens))
    ids = torch.tensor([[*t, *[0] * (length - len(t))] for t in tokens], device=device)
    mask = torch.tensor([[1] * len(t) + [0] * (length - len(t)) for t in tokens], device=device)
    places = [range(i * length, i * length + len(t)) for i, t in enumerate(tokens)]
    return {"input_ids": ids, "attention_mask": mask}, places


def frozen_output(
    model: nn.Module,
    layers: Sequence[nn.Module],
    rows: Sequence[Row],
    recorded: Recorded | None = None,
    *,
    packing: Packing = "padded",
    tokens_per_forward: int = 0,
    limit: int = LIMIT,
) -> FrozenOutput | None:
    """What comes out of the frozen `layers` of `model` for the trained rows of a round, as many as fit into `limit`.

    Args:
        recorded: what the rollouts know of it; the rest is computed, `tokens_per_forward` at a time.
        limit: bytes of output to keep.
    """
    if not layers:
        return None
    decoder, weights = language_model(model).base_model, next(model.parameters())
    width = decoder.config.hidden_size
    rows = sorted((r for r in rows if r.sequence.trained), key=lambda r: r.sequence.tokens)
    places = [(i, p) for i, r in enumerate(rows) for p, m in enumerate(r.sequence.mask) if m]
    tokens = _first(_read([r.sequence for r in rows], places), limit // (width * weights.element_size()))
    if not tokens:
        return None
    tree = build_tree(tokens)
    states, missing = weights.new_empty(len(tree.tokens), width), []
    for i, read in enumerate(tokens):
        known = recorded(read) if recorded else None
        if known is None:
            missing.append(i)
        else:
            states[tree.places[i]] = known
    budget = tokens_per_forward or (FROZEN_TOKENS if packing == "tree" else 0)
    for chunk in _chunks(rows, missing, packing, budget):
        inputs, packed = _packed(packing, [tokens[i] for i in chunk], weights.device)
        found = output_of(decoder, layers, **inputs).flatten(0, 1)
        for i, here in zip(chunk, packed, strict=True):
            states[tree.places[i]] = found[list(here)]
    output = FrozenOutput(layers, states)
    for row, there in zip(rows, tree.places, strict=False):  # those that fit
        output.add(row.sequence, there)
    return output


def _first(tokens: Sequence[list[int]], distinct: int) -> list[list[int]]:
    """As many of the sorted token lists as have at most `distinct` prefixes."""
    for i, read in enumerate(tokens):
        distinct -= len(read) - (shared_prefix(tokens[i - 1], read) if i else 0)
        if distinct < 0:
            return list(tokens[:i])
    return list(tokens)
