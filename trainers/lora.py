"""LoRA layers of an update on a CPU: one product forward and one backward, the adapter merged in.

PEFT multiplies by the base weight W and, beside it, by two thin matrices B A, and adds: four more passes over every
output. Here both products are with W + s B A, through oneDNN's packed kernels, as while sampling
(`agentspec.llm.local.invariance`); gradients of A and B follow from the input and the output's gradient.
The merged weight is formed again backward, never kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import nn

from agentspec.llm.local.invariance import mergeable, packs
from trainers.frozen import replaced


@contextmanager
def merged_lora(model: nn.Module) -> Iterator[None]:
    """Inside, plain float32 LoRA layers on a CPU compute merged; all else, and layers recomputed backward, as ever."""
    checkpointing = any(getattr(m, "gradient_checkpointing", False) for m in model.modules())
    found = [(m, *mergeable(m)) for m in model.modules() if hasattr(m, "lora_A")] if packs() else []
    merged = {
        module: partial(_forward, module, linear, adapters[0])
        for module, linear, adapters in found
        if linear is not None and len(adapters) == 1 and not any(p.requires_grad for p in linear.parameters())
    }
    with replaced({} if checkpointing else merged):
        yield


def _forward(module: Any, linear: nn.Linear, adapter: str, x: torch.Tensor) -> torch.Tensor:
    a, b = module.lora_A[adapter].weight, module.lora_B[adapter].weight
    out: torch.Tensor = _Merged.apply(x, a, b, linear.weight, linear.bias, module.scaling[adapter])
    return out


class _Merged(torch.autograd.Function):
    """x (..., in) -> x (W + s B A)^T + bias, with gradients of x, A (r, in) and B (out, r)."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, a: Any, b: Any, weight: Any, bias: Any, scale: float) -> torch.Tensor:
        ctx.save_for_backward(x, a, b, weight)
        ctx.scale = scale
        return _product(x, torch.addmm(weight, b, a, alpha=scale), bias)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> Any:
        x, a, b, weight = ctx.saved_tensors
        rows, out = x.flatten(0, -2), gradient.flatten(0, -2)
        # Thin products this way round: the other takes MKL up to five times as long.
        of_a = ctx.scale * ((b.t() @ out.t()) @ rows)
        of_b = ctx.scale * ((a @ rows.t()) @ out).t()
        of_x = None
        if ctx.needs_input_grad[0]:
            of_x = _product(gradient, torch.addmm(weight.t(), a.t(), b.t(), alpha=ctx.scale), None)
        return of_x, of_a, of_b, None, None, None


def _product(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
    packed = torch.ops.mkldnn._reorder_linear_weight(weight)
    out: torch.Tensor = torch.ops.mkldnn._linear_pointwise(x.contiguous(), packed, bias, "none", [], "")
    return out
