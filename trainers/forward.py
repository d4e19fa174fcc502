"""Log-probabilities of a micro-batch: padded rows or a prefix tree, in one forward or in several within a token budget.

Every trained token is computed. Rows without a policy gradient may be computed without a graph: their log-probabilities
and entropies are in the figures of the update, but they cost no backward pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.checkpoint import checkpoint

from agentspec.tokens import shared_prefix
from trainers.logprobs import sampled_logprobs
from trainers.micro_batches import padding_row
from trainers.sequences import Row, TokenSequence
from trainers.tree.model import packed_inputs, wanted_tokens
from trainers.tree.trie import build_tree

Packing = Literal["tree", "padded"]
Places = Sequence[tuple[int, int]]


def rows_logprobs(
    model: nn.Module,
    rows: Sequence[Row],
    *,
    skip_backward: bool = False,
    packing: Packing = "padded",
    tokens_per_forward: int = 0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probabilities and entropies of all trained tokens of a micro-batch.

    Logits are computed only where a token is trained. Untrained places hold 0.

    Args:
        skip_backward: compute rows without a policy gradient without a graph.
        packing: `padded` rows, or a prefix `tree` (the model must know it: `trainers.tree.model.enable_tree`).
        tokens_per_forward: token budget of a forward (0: no bound for a tree, one row for padded ones). If one forward
            does not hold the micro-batch, forwards are recomputed in the backward pass, so that activations of one
            chunk at a time are kept.

    Returns:
        two float32 tensors of shape (B, L-1), aligned with `completion_ids` of `trainers.micro_batches.collate`.
    """
    trained = [i for i, r in enumerate(rows) if r.sequence.trained]
    still = [i for i in trained if skip_backward and rows[i].zero_gradient]
    live = [i for i in trained if i not in set(still)]
    forward = _tree_forward if packing == "tree" else _padded_forward
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
    model: nn.Module, sequences: Sequence[TokenSequence], places: Places, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probability and entropy of every place, from one packed forward."""
    tokens = [s.tokens for s in sequences]
    tree = build_tree(tokens)
    output = model(
        **packed_inputs(tree, device),
        **wanted_tokens(
            tree,
            tokens,
            places,
            device,
            temperatures=[sequences[r].temperatures[p] for r, p in places],
            allowed=[sequences[r].allowed.get(p) for r, p in places],
        ),
    )
    return output.log_probs, output.entropies


def _padded_forward(
    model: nn.Module, sequences: Sequence[TokenSequence], places: Places, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probability and entropy of every place, from one padded forward."""
    length = max(len(s) for s in sequences)
    ids = torch.zeros(len(sequences), length, dtype=torch.long)
    attention = torch.zeros_like(ids)
    for i, s in enumerate(sequences):
        ids[i, : len(s)] = torch.tensor(s.tokens)
        attention[i, : len(s)] = 1
    # The logits before a token decide it. Only positions that some row trains are projected on the vocabulary.
    keep = sorted({p - 1 for _, p in places})
    column = {p: k for k, p in enumerate(keep)}
    logits = model(
        input_ids=ids.to(device),
        attention_mask=attention.to(device),
        logits_to_keep=torch.tensor(keep, device=device),
        use_cache=False,
    ).logits
    rows = torch.tensor([r for r, _ in places], device=device)
    columns = torch.tensor([column[p - 1] for _, p in places], device=device)
    tokens = torch.tensor([sequences[r].tokens[p] for r, p in places], device=device)
    temperatures = torch.tensor([sequences[r].temperatures[p] for r, p in places], device=device)
    allowed = [sequences[r].allowed.get(p) for r, p in places]
    return sampled_logprobs(logits[rows, columns], tokens, temperatures, allowed)
