"""Log-probabilities of a micro-batch: padded rows or a prefix tree, in one forward or in several within a token budget.

Every trained token is computed. Rows without a policy gradient may be computed without a graph: their log-probabilities
and entropies are in the figures of the update, but they cost no backward pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.checkpoint import checkpoint

from agentspec.tokens import shared_prefix
from trainers.frozen import LIMIT, FrozenOutput, language_model, output_of
from trainers.logprobs import sampled_logprobs
from trainers.micro_batches import padding_row
from trainers.sequences import Row, TokenSequence
from trainers.tree.model import decoder_inputs, packed_inputs, wanted_tokens
from trainers.tree.trie import Tree, build_tree

Packing = Literal["tree", "padded"]
Places = Sequence[tuple[int, int]]
Recorded = Callable[[Sequence[int]], torch.Tensor | None]
"""Tokens -> what came out of the frozen layers when the rollouts read them, (n, hidden), if that is known."""
FROZEN_TOKENS = 8192
"""Tokens whose frozen output is computed in one forward of a tree, where no other budget is set."""


class Packed(NamedTuple):
    """Token lists as the inputs of one forward, shape (B, L), and where in it, flattened, the tokens of each are."""

    inputs: dict[str, torch.Tensor]
    places: Sequence[Sequence[int]]
    tree: Tree | None = None


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
    forward = partial(_tree_forward if packing == "tree" else _padded_forward, frozen=frozen)
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


def _tree_forward(
    model: nn.Module,
    sequences: Sequence[TokenSequence],
    places: Places,
    device: torch.device,
    frozen: FrozenOutput | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probability and entropy of every place, from one packed forward."""
    packed = _packed("tree", _read(sequences, places), device)
    assert packed.tree is not None
    wanted = wanted_tokens(
        packed.tree,
        [s.tokens for s in sequences],
        places,
        device,
        temperatures=[sequences[r].temperatures[p] for r, p in places],
        allowed=[sequences[r].allowed.get(p) for r, p in places],
    )
    with _started(frozen, sequences, packed):
        output = model(**packed.inputs, **wanted)
    return output.log_probs, output.entropies


def _padded_forward(
    model: nn.Module,
    sequences: Sequence[TokenSequence],
    places: Places,
    device: torch.device,
    frozen: FrozenOutput | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probability and entropy of every place, from one padded forward."""
    packed = _packed("padded", _read(sequences, places), device)
    # The logits before a token decide it. Only positions that some row trains are projected on the vocabulary.
    keep = sorted({p - 1 for _, p in places})
    column = {p: k for k, p in enumerate(keep)}
    with _started(frozen, sequences, packed):
        logits = model(**packed.inputs, logits_to_keep=torch.tensor(keep, device=device), use_cache=False).logits
    rows = torch.tensor([r for r, _ in places], device=device)
    columns = torch.tensor([column[p - 1] for _, p in places], device=device)
    tokens = torch.tensor([sequences[r].tokens[p] for r, p in places], device=device)
    temperatures = torch.tensor([sequences[r].temperatures[p] for r, p in places], device=device)
    allowed = [sequences[r].allowed.get(p) for r, p in places]
    return sampled_logprobs(logits[rows, columns], tokens, temperatures, allowed)


def _read(sequences: Sequence[TokenSequence], places: Places) -> list[list[int]]:
    """Of each sequence the tokens that something is predicted from: those before its last place."""
    ends = [0] * len(sequences)
    for r, p in places:
        ends[r] = max(ends[r], p)
    return [s.tokens[:end] for s, end in zip(sequences, ends, strict=True)]


def _packed(packing: Packing, tokens: Sequence[list[int]], device: torch.device) -> Packed:
    """The inputs of one forward of all token lists: a prefix tree, or rows padded right."""
    if packing == "tree":
        tree = build_tree(tokens)
        return Packed(packed_inputs(tree, device), tree.places, tree)
    length = max(map(len, tokens))
    ids = torch.tensor([[*t, *[0] * (length - len(t))] for t in tokens], device=device)
    mask = torch.tensor([[1] * len(t) + [0] * (length - len(t)) for t in tokens], device=device)
    places = [range(i * length, i * length + len(t)) for i, t in enumerate(tokens)]
    return Packed({"input_ids": ids, "attention_mask": mask}, places)


def _started(
    frozen: FrozenOutput | None, sequences: Sequence[TokenSequence], packed: Packed
) -> AbstractContextManager[None]:
    if frozen is None:
        return nullcontext()
    return frozen.given(sequences, packed.places, tuple(packed.inputs["input_ids"].shape))


def frozen_output(
    model: nn.Module,
    layers: Sequence[nn.Module],
    rows: Sequence[Row],
    *,
    packing: Packing = "padded",
    tokens_per_forward: int = 0,
    recorded: Recorded = lambda tokens: None,
    limit: int = LIMIT,
) -> FrozenOutput | None:
    """What comes out of the frozen `layers` of `model` for the trained rows of a round, as many as fit into `limit`.

    Args:
        recorded: what the rollouts know of it; the rest is computed, `tokens_per_forward` at a time.
        limit: bytes of output to keep.
    """
    decoder, weights = language_model(model).base_model, next(model.parameters())
    rows = sorted((r for r in rows if r.sequence.trained), key=lambda r: r.sequence.tokens)
    places = [(i, p) for i, r in enumerate(rows) for p, m in enumerate(r.sequence.mask) if m]
    tokens = _read([r.sequence for r in rows], places)
    tokens = _first(tokens, limit // (decoder.config.hidden_size * weights.element_size()))
    if not layers or not tokens:
        return None
    tree = build_tree(tokens)
    known = list(map(recorded, tokens))
    parts = [(there, states) for there, states in zip(tree.places, known, strict=True) if states is not None]
    missing = [i for i, states in enumerate(known) if states is None]
    budget = tokens_per_forward or (FROZEN_TOKENS if packing == "tree" else 0)
    for chunk in _chunks(rows, missing, packing, budget):
        packed = _packed(packing, [tokens[i] for i in chunk], weights.device)
        inputs = packed.inputs | (decoder_inputs(packed.tree, weights.device) if packed.tree else {})
        states = output_of(decoder, layers, **inputs).flatten(0, 1)
        parts += [(tree.places[i], states[list(here)]) for i, here in zip(chunk, packed.places, strict=True)]
    first = parts[0][1]
    whole = first.new_empty(len(tree.tokens), first.shape[-1])
    for there, states in parts:
        whole[there] = states
    output = FrozenOutput(layers, whole)
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
