"""A run ends at the first number that is none, before anything of it is saved.

transformers logs a loss of NaN as 0.0 and goes on, and the weights are NaN from there: nothing in the logs says so.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import nn
from transformers import TrainerCallback


class NonFiniteError(ValueError):
    """A loss, a gradient or a weight is NaN or infinite."""


class FiniteGuard(TrainerCallback):
    """Looks at gradients before, and at trained weights after every optimiser step."""

    def on_pre_optimizer_step(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        if not args.fp16:  # there the gradient scaler expects infinities, and skips the step
            named = ((n, p.grad) for n, p in kwargs["model"].named_parameters() if p.grad is not None)
            require_finite("gradient", named, state.global_step)

    def on_optimizer_step(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        named = ((n, p.detach()) for n, p in kwargs["model"].named_parameters() if p.requires_grad)
        require_finite("weight", named, state.global_step)


def require_finite(what: str, named: Iterable[tuple[str, torch.Tensor]], step: int) -> None:
    """Refuse (`NonFiniteError`) a tensor that is not finite: which it is, and of which update.

    Args:
    named: names and tensors; of sharded ones this process's part.
    step: number of updates made before.
    """
    local = {n: t.to_local() if hasattr(t, "to_local") else t for n, t in named}
    tensors = {n: t.abs().max().isfinite() for n, t in local.items() if t.numel()}
    finite = torch.stack(list(tensors.values())).tolist() if tensors else []  # one look at the device for all
    bad = [n for n, ok in zip(tensors, finite, strict=True) if not ok]
    if bad:
        raise NonFiniteError(
            f"{what} of update {step} is not finite ({len(bad)} of {len(tensors)}, the first: {bad[0]}); nothing of it "
            "was saved. Lower learning_rate or set max_grad_norm; a reference (beta) or a temperature that makes "
            "log-probabilities infinite shows here too"
        )


def without_dropout(model: nn.Module) -> None:
    """Turn dropout off for good: an update must see the probabilities that were sampled from.

    A warm-start adapter may bring `lora_dropout`, a base model `attention_dropout`; their configurations stay.
    """
    for module in model.modules():
        if isinstance(module, nn.modules.dropout._DropoutNd):
            module.p = 0.0
        for name, value in list(vars(module).items()):
            if name.endswith("dropout") and isinstance(value, float):
                setattr(module, name, 0.0)
