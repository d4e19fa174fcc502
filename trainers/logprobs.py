"""Log-probabilities of sampled tokens under the distribution they were sampled from.

A token sampled freely at temperature T has the log-softmax of `logits / T`; a token sampled under a constraint has
the log-softmax over the ids the constraint left. These are the numbers the rollout recorded, so recomputing them with
unchanged weights gives the same values, and their gradient is the policy gradient of the policy that acted.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch.nn.utils.rnn import pad_sequence


def sampled_logprobs(
    logits: torch.Tensor,
    tokens: torch.Tensor,
    temperatures: torch.Tensor,
    allowed: Sequence[tuple[int, ...] | None],
) -> tuple[torch.Tensor, torch.Tensor]:
    """Log-probability and entropy of each token.

    Args:
        logits: shape (K, V), any float dtype; the reduction is done in float32.
        tokens: shape (K,), the sampled ids.
        temperatures: shape (K,), > 0.
        allowed: per token the ids its constraint left, or `None`.

    Returns:
        log-probabilities (K,) with gradient and entropies (K,) without, both float32, in nats.

    Raises:
        ValueError: lengths differ, or a token that its own constraint does not contain.
    """
    count = tokens.shape[0]
    if logits.shape[0] != count or temperatures.shape[0] != count or len(allowed) != count:
        raise ValueError(
            f"one row of logits, temperature and constraint per token: got {logits.shape[0]}, "
            f"{temperatures.shape[0]} and {len(allowed)} for {count} tokens"
        )
    logps = logits.new_zeros(count, dtype=torch.float32)
    entropies = logits.new_zeros(count, dtype=torch.float32)
    free = [i for i, a in enumerate(allowed) if a is None]
    bound = [i for i, a in enumerate(allowed) if a is not None]
    for indices, restrict in ((free, False), (bound, True)):
        if not indices:
            continue
        index = torch.tensor(indices, device=logits.device)
        scaled = logits[index].float() / temperatures[index].unsqueeze(1)
        target = tokens[index]
        if restrict:
            scaled, target = _restrict(scaled, target, [allowed[i] or () for i in indices])
        log_p = scaled.log_softmax(dim=-1)
        logps = logps.index_put((index,), log_p.gather(1, target.unsqueeze(1)).squeeze(1))
        with torch.no_grad():
            terms = torch.where(log_p > -torch.inf, log_p.exp() * log_p, torch.zeros_like(log_p))
            entropies = entropies.index_put((index,), -terms.sum(dim=-1))
    return logps, entropies


def _restrict(
    scaled: torch.Tensor, tokens: torch.Tensor, allowed: Sequence[tuple[int, ...]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits of the allowed ids only (K, A), padded with -inf, and each token's place among them (K,)."""
    for choices, token in zip(allowed, tokens.tolist(), strict=True):
        if token not in choices:
            raise ValueError(f"token {token} is not among the ids its constraint allowed: {choices}")
    ids = pad_sequence([torch.tensor(choices) for choices in allowed], batch_first=True)
    outside = torch.arange(ids.shape[1])[None] >= torch.tensor([len(choices) for choices in allowed])[:, None]
    places = [choices.index(token) for choices, token in zip(allowed, tokens.tolist(), strict=True)]
    device = scaled.device
    narrowed = scaled.gather(1, ids.to(device)).masked_fill(outside.to(device), -torch.inf)
    return narrowed, torch.tensor(places, device=device)
