"""Rows -> micro-batches, and the log-probabilities of a micro-batch.

The number of micro-batches is fixed by the configuration; the number of rows is not. Rows are dealt so that every
micro-batch holds the same number of rows (short of one) and about the same number of tokens; empty places are filled
with rows that train nothing. So no row is ever lost and the number of optimiser steps never depends on the scaffold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.checkpoint import checkpoint

from agentspec.tokens import shared_prefix
from trainers.logprobs import sampled_logprobs
from trainers.sequences import Row, TokenSequence
from trainers.tree import build_tree, packed_inputs, wanted_tokens

Packing = Literal["tree", "padded"]

ROWS = "rows"
"""Key under which a micro-batch carries its rows beside the tensors that TRL reads."""


def blank_row(token: int) -> Row:
    """A row of two tokens that trains nothing: fills a place."""
    sequence = TokenSequence()
    sequence.extend_context([token, token])
    return Row(sequence, 0.0, -1)


def deal(
    rows: Sequence[Row], hands: int, *, blank: Row, rows_per_hand: int = 0, together: bool = False
) -> list[list[Row]]:
    """Deal rows into ``hands`` micro-batches of equal size.

    Longest first, each row goes to the hand with the fewest tokens that still has room; or, with ``together``, rows
    that share prefixes stay in one hand. ``rows_per_hand`` asks for more room than the rows need (another rank has
    more).

    Raises:
        ValueError: ``rows_per_hand`` is too small.
    """
    size = max(rows_per_hand, -(-len(rows) // hands), 1)
    if rows_per_hand and rows_per_hand * hands < len(rows):
        raise ValueError(f"{len(rows)} rows do not fit into {hands} micro-batches of {rows_per_hand}")
    dealt: list[list[Row]] = [[] for _ in range(hands)]
    if together:
        ordered = sorted(rows, key=lambda r: r.sequence.tokens)
        share = -(-len(rows) // hands) if rows else 0
        dealt = [ordered[h * share : (h + 1) * share] for h in range(hands)]
    else:
        tokens = [0] * hands
        for row in sorted(rows, key=lambda r: -len(r.sequence)):
            hand = min((h for h in range(hands) if len(dealt[h]) < size), key=lambda h: (tokens[h], h))
            dealt[hand].append(row)
            tokens[hand] += len(row.sequence)
    return [hand + [blank] * (size - len(hand)) for hand in dealt]


def collate(
    rows: Sequence[Row], pad: int, device: torch.device | str = "cpu", *, skip_silent: bool = False
) -> dict[str, torch.Tensor]:
    """The tensors TRL's loss reads, right-padded; the first token stands as the prompt, all others as completion.

    With ``skip_silent`` the mask of rows without a policy gradient is empty, so that metrics leave them out as the
    forward does (they still count in the loss denominator, which is computed before).

    Shapes with B rows of at most L tokens: ``prompt_ids``, ``prompt_mask`` (B, 1); ``completion_ids``,
    ``completion_mask``, ``tool_mask`` and ``sampled_logprobs`` (B, L-1); ``advantages`` (B,) or, if any row has one per
    token, (B, L-1).
    """
    length = max(len(r.sequence) for r in rows)
    ids = torch.full((len(rows), length), pad, dtype=torch.long)
    attention = torch.zeros_like(ids)
    mask = torch.zeros_like(ids)
    logprobs = torch.zeros(len(rows), length)
    per_token = any(not isinstance(r.advantage, (int, float)) for r in rows)
    advantages = torch.zeros(len(rows), length) if per_token else torch.zeros(len(rows))
    for i, row in enumerate(rows):
        n = len(row.sequence)
        ids[i, :n] = torch.tensor(row.sequence.tokens)
        attention[i, :n] = 1
        if not (skip_silent and row.zero_gradient):
            mask[i, :n] = torch.tensor(row.sequence.mask)
        logprobs[i, :n] = torch.tensor(row.sequence.logprobs)
        if per_token:
            advantages[i, :n] = torch.tensor(row.advantage)
        else:
            advantages[i] = row.advantage  # type: ignore[assignment]  # a number: per_token is False
    batch = {
        "prompt_ids": ids[:, :1],
        "prompt_mask": attention[:, :1],
        "completion_ids": ids[:, 1:],
        "completion_mask": attention[:, 1:],
        "tool_mask": mask[:, 1:],
        "sampled_logprobs": logprobs[:, 1:],
        "advantages": advantages[:, 1:] if per_token else advantages,
    }
    return {name: tensor.to(device) for name, tensor in batch.items()}


def rows_logprobs(
    model: nn.Module,
    rows: Sequence[Row],
    *,
    skip_silent: bool = False,
    packing: Packing = "padded",
    tokens_per_forward: int = 0,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probabilities and entropies of all trained tokens of a micro-batch.

    Logits are computed only where a token is trained. Untrained places hold 0.

    Args:
        skip_silent: leave out rows without a policy gradient (their values stay 0).
        packing: ``padded`` rows, or a prefix ``tree`` (the model must know it: :func:`trainers.tree.enable_tree`).
        tokens_per_forward: token budget of a forward (0: no bound for a tree, one row for padded ones). If one forward
            does not hold the micro-batch, forwards are recomputed in the backward pass, so that activations of one
            chunk at a time are kept.

    Returns:
        two float32 tensors of shape (B, L-1), aligned with ``completion_ids`` of :func:`collate`.
    """
    device = next(model.parameters()).device
    length = max(len(r.sequence) for r in rows)
    logps = torch.zeros(len(rows), length - 1, device=device)
    entropies = torch.zeros(len(rows), length - 1, device=device)
    todo = [i for i, r in enumerate(rows) if r.sequence.trained and not (skip_silent and r.zero_gradient)]
    forward = _tree_forward if packing == "tree" else _padded_forward
    chunks = list(_chunks(rows, todo, packing, tokens_per_forward))
    recompute = packing == "tree" and len(chunks) > 1 and torch.is_grad_enabled()
    # DDP arms its gradient reduction in forward, once per backward: the first forward is its own and is not repeated
    # in the backward pass; the others go to the module inside.
    replicated = isinstance(model, DistributedDataParallel)
    inner: Any = model.module if replicated else model
    for number, chunk in enumerate(chunks):
        sequences = [rows[i].sequence for i in chunk]
        places = [(i, p) for i, s in enumerate(sequences) for p, m in enumerate(s.mask) if m]
        arms = replicated and number == 0
        if recompute and not arms:
            logp, entropy = checkpoint(forward, inner, sequences, places, device, use_reentrant=False)
        else:
            logp, entropy = forward(model if arms else inner, sequences, places, device)
        index = (
            torch.tensor([chunk[r] for r, _ in places], device=device),
            torch.tensor([p - 1 for _, p in places], device=device),
        )
        logps = logps.index_put(index, logp)
        entropies = entropies.index_put(index, entropy.detach())
    if not todo:
        # Every rank takes part in the forward and the backward pass, with or without something to learn: otherwise
        # the others would wait for its gradients.
        logps = logps + 0.0 * forward(model, [blank_row(0).sequence], [(0, 1)], device)[0].sum()
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
    model: nn.Module, sequences: Sequence[TokenSequence], places: Sequence[tuple[int, int]], device: torch.device
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
    model: nn.Module, sequences: Sequence[TokenSequence], places: Sequence[tuple[int, int]], device: torch.device
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
