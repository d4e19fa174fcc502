"""How far two gradients of the same update are apart, and which of them is nearer to the gradient in float64.

- `rel_grad_diff`: norm of the difference of the whole gradients over the norm of stock TRL's.
- `max_rel_grad_diff`: the same of the parameter (a matrix of LoRA) where it is largest, `max_rel_grad_diff_at`, with
  the share that this parameter's norm has of the whole gradient's. Never element by element: where an element is near
  0, its relative difference says nothing.

Float32 bounds both from below. A parameter's gradient is a sum over all tokens of products that cancel in part: where
most is cancelled the sum is small, and what was rounded off its terms is a larger part of it. Attention's queries and
keys are hit hardest, as a softmax passes on only how scores differ. So two correct programs that sum in another order
differ there by more than they do as a whole. Stock TRL is no reference for that: it too is as far from the exact
gradient. `--reference` computes stock TRL's update in float64 and tells how far either side is from that: `trl_error`,
`ours_error`, `alone_error` of the whole gradient, and of the parameter where it is largest `trl_max_error`, and so on.
A difference between the sides of up to the sum of their errors is rounding.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import torch

Gradients = dict[str, torch.Tensor]
"""By the parameter's name."""


def gradients(trainer: Any) -> Gradients:
    """Gradients of the last update, cleared for the next."""
    named = {n: p.grad.clone() for n, p in trainer.model.named_parameters() if p.grad is not None}
    trainer.model.zero_grad(set_to_none=True)
    return named


def differences(got: Gradients, expected: Gradients) -> dict[str, Any]:
    """Of `got` from `expected`, as the module says."""
    apart = {n: float((got[n].double() - g.double()).norm()) for n, g in expected.items()}
    norms = {n: float(g.double().norm()) for n, g in expected.items()}
    whole = math.hypot(*norms.values())
    worst = max((n for n in norms if norms[n]), key=lambda n: apart[n] / norms[n])
    return {
        "max_rel_grad_diff": apart[worst] / norms[worst],
        "max_rel_grad_diff_at": {"parameter": worst, "share_of_gradient": norms[worst] / whole},
        "rel_grad_diff": math.hypot(*apart.values()) / whole,
    }


def in_float64(trainer: Any, update: Callable[[], None]) -> Gradients:
    """Gradients of `update` with the trainer's model in float64 for as long as it runs.

    Its norms too, which transformers computes in float32 whatever the model is in; angles of positions stay float32.
    """
    model = trainer.model
    norms = [m for m in model.modules() if hasattr(m, "variance_epsilon")]
    model.double()
    for norm in norms:
        norm.forward = functools.partial(_normed, norm)
    try:
        update()
        return gradients(trainer)
    finally:
        for norm in norms:
            del norm.forward
        model.float()


def _normed(norm: Any, x: torch.Tensor) -> torch.Tensor:
    out: torch.Tensor = norm.weight * (x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + norm.variance_epsilon))
    return out


def errors(found: Mapping[str, Gradients], reference: Gradients) -> dict[str, float]:
    """How far each side is from the reference: its whole gradient, and the worst parameter's."""
    apart = {side: differences(g, reference) for side, g in found.items()}
    kinds = {"error": "rel_grad_diff", "max_error": "max_rel_grad_diff"}
    return {f"{side}_{kind}": of[key] for side, of in apart.items() for kind, key in kinds.items()}
