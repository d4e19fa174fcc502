"""The last layer's feed-forward part, only where logits are wanted.

Above the last attention every token is on its own, and what a prompt's tokens come to there is asked for at its end
only: of SmolLM2's products while reading, a fortieth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn


def feed_forward(layer: nn.Module) -> list[nn.Module]:
    """The parts of a decoder layer that multiply, except attention; none that somebody else has wrapped."""
    parts = []
    for part in layer.children():
        inside = list(part.modules())
        attends = any(hasattr(m, "layer_idx") for m in inside)
        hooked = any("forward" in vars(m) or m._forward_hooks or m._forward_pre_hooks for m in inside)
        if any(type(m) is nn.Linear for m in inside) and not attends and not hooked:
            parts.append(part)
    return parts


@contextmanager
def only_at(parts: list[nn.Module], places: torch.Tensor, tokens: int) -> Iterator[None]:
    """Inside, `parts` give zeros for all of the `tokens` in a row but those at `places`."""
    try:
        for part in parts:
            part.forward = _narrowed(part.forward, places, tokens)
        yield
    finally:
        for part in parts:
            vars(part).pop("forward", None)  # the class's own is seen again


def _narrowed(forward: Callable[..., Any], places: torch.Tensor, tokens: int) -> Callable[..., Any]:
    def narrowed(x: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        if args or kwargs or x.dim() != 3 or x.shape[1] != tokens:
            return forward(x, *args, **kwargs)
        some = forward(x[:, places])
        if not isinstance(some, torch.Tensor) or some.shape[:2] != (1, len(places)):
            return forward(x)
        out = some.new_zeros(1, tokens, some.shape[2])
        out[:, places] = some
        return out

    return narrowed
