"""Drawing tokens from logits, for all rows of a forward at once: free and among choices, temperature, top-k and top-p.

Sampling inverts the cumulative distribution at a row's own uniform number, so what a row samples does not depend on
what it is batched with.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from agentspec.llm.local.invariance import elementwise
from agentspec.llm.local.rows import ChoiceRow, FreeRow


def choose(rows: Sequence[ChoiceRow], logits: torch.Tensor) -> None:
    """Sample one allowed token per row from ``logits`` (rows, V), renormalised over the allowed ids.

    Temperature applies; top-p and top-k do not. At temperature 0 the best is taken and its log-probability at
    temperature 1 recorded.
    """
    width = max(len(r.allowed) for r in rows)
    ids = torch.tensor([[*r.allowed, *[r.allowed[0]] * (width - len(r.allowed))] for r in rows], device=logits.device)
    values = logits.gather(1, ids).cpu()
    for row, line in zip(rows, values, strict=True):
        temperature = row.job.sampling.temperature
        allowed = row.allowed
        logprobs = torch.log_softmax(line[: len(allowed)] / (temperature or 1.0), -1)
        if temperature == 0:
            pick = int(logprobs.argmax())
        else:
            cumulative = logprobs.double().exp().cumsum(0)
            pick = min(int((cumulative <= row.uniform() * cumulative[-1]).sum()), len(allowed) - 1)
        row.take(allowed[pick], float(logprobs[pick]))


def sample(rows: Sequence[FreeRow], logits: torch.Tensor) -> None:
    """Sample one token per row from ``logits`` (rows, V): temperature, then top-k, then top-p, renormalised.

    At temperature 0 the best token is taken and its log-probability at temperature 1 recorded.
    """
    settings = [r.job.sampling for r in rows]
    temperatures = torch.tensor([s.temperature or 1.0 for s in settings], device=logits.device)
    logprobs = torch.log_softmax(logits / temperatures[:, None], -1)
    for i, s in enumerate(settings):
        if s.temperature > 0 and (s.top_k or s.top_p < 1):
            logprobs[i] = filter_top(logprobs[i], s.top_k, s.top_p)
    exact = torch.float32 if logits.device.type == "mps" else torch.float64
    uniforms = torch.tensor([[r.uniform()] for r in rows], dtype=exact, device=logits.device)
    cumulative = elementwise(torch.exp, logprobs.to(exact)).cumsum_(-1)
    picks = torch.searchsorted(cumulative, uniforms * cumulative[:, -1:], right=True).clamp_(max=logits.shape[1] - 1)
    if any(s.temperature == 0 for s in settings):
        greedy = torch.tensor([[s.temperature == 0] for s in settings], device=logits.device)
        picks = torch.where(greedy, logprobs.argmax(-1, keepdim=True), picks)
    chosen = logprobs.gather(1, picks)
    for row, token, logprob in zip(rows, picks[:, 0].tolist(), chosen[:, 0].tolist(), strict=True):
        row.take(token, logprob)


def filter_top(logprobs: torch.Tensor, top_k: int, top_p: float) -> torch.Tensor:
    """Log-probabilities (V,) with all but the ``top_k`` best, then all but the nucleus ``top_p``, set to -inf.

    The nucleus is the smallest set of best tokens whose probabilities reach ``top_p``; what is left is renormalised.
    """
    values, order = logprobs.sort(descending=True)
    if top_k:
        values, order = values[:top_k], order[:top_k]
        values = values - values.logsumexp(-1)
    if top_p < 1:
        probabilities = values.exp()
        before = probabilities.cumsum(-1) - probabilities
        keep = int((before < top_p).sum())
        values, order = values[:keep], order[:keep]
        values = values - values.logsumexp(-1)
    return torch.full_like(logprobs, float("-inf")).scatter_(0, order, values)
