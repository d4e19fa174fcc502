"""Batch invariance: a token's logits depend on its context only, to the last bit, whoever else is in the batch.

A matrix product is a sum, and a library picks its order by shape: MKL has kernels of their own for 1 row, for 2 and 3,
and for 4 and more (on some processors, whatever `MKL_CBWR` says), and shares small products among threads in pieces
that have kernels of their own again. Elementwise functions are computed many at a time, and the odd ones at the end of
a thread's share by another formula. So the last bits of a row depend on how many rows there are. Inside
`InvariantModules.in_use`, on a CPU in float32, they do not:

- Linear layers multiply through oneDNN with prepacked weights. Its kernels treat rows alike from 2 rows on (one row of
  1,536 numbers is summed otherwise), so a forward never has fewer than `MIN_ROWS`. Packing is also faster than MKL's
  products, at a few rows by half; it costs a second copy of the weights in memory.
- A LoRA layer is packed as the sum of its base and its active adapter. Weights are packed again only when they, or the
  adapter, changed.
- Activation functions are computed in pieces that end where whole vectors end.

Attention takes care of itself (`agentspec.llm.local.attention`). Whether all that holds for a model, on the machine
and with the present number of threads, is tried out by `agentspec.llm.local.probe`, never assumed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import nn

MIN_ROWS = 4
"""Rows of tokens, and of the head, that a forward on a CPU has at least."""

_LANES = 32
"""Floats of two AVX-512 vectors, which elementwise loops take at a time."""
_GRAIN = 32768
"""Numbers below which an elementwise function is not shared among threads (`at::internal::GRAIN_SIZE`)."""
_ACTIVATIONS = (nn.SiLU, nn.GELU, nn.Tanh, nn.Sigmoid, nn.Mish)


@dataclass(frozen=True)
class _Packed:
    """A packed weight and what it was made from; holding the parts keeps their addresses from being used again."""

    weight: torch.Tensor
    key: tuple[Any, ...]
    parts: list[torch.Tensor]


class InvariantModules:
    """Replaces the forward of a model's linear layers and activation functions, for as long as it is asked to.

    Args:
        model: a transformers model, or a PEFT model around one.
    """

    def __init__(self, model: nn.Module) -> None:
        self._model = model
        self._packed: WeakKeyDictionary[nn.Module, dict[tuple[str, ...], _Packed]] = WeakKeyDictionary()

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """The active adapter's weights multiply as packed ones inside; the model's modules are themselves again after.

        Nothing is replaced off the CPU, in other float types, under autocast, or where oneDNN is missing.
        """
        replaced: list[nn.Module] = []
        try:
            if packs() and next(self._model.parameters()).device.type == "cpu":
                for module, forward in self._replacements():
                    module.forward = forward
                    replaced.append(module)
            yield
        finally:
            for module in replaced:
                del module.forward  # the class's own is seen again

    def clear(self) -> None:
        """Forget all packed weights."""
        self._packed.clear()

    def _replacements(self) -> Iterator[tuple[nn.Module, Callable[..., torch.Tensor]]]:
        inside: set[int] = set()
        for module in self._model.modules():
            if id(module) in inside or not _is_plain(module):
                continue
            linear, adapters = mergeable(module)
            if linear is not None:
                inside.update(map(id, module.modules()))
                yield module, _product(self._weight(module, linear, adapters), linear.bias)
            elif isinstance(module, _ACTIVATIONS) or type(module).__module__ == "transformers.activations":
                yield module, _in_whole_vectors(module.forward)

    def _weight(self, module: Any, linear: nn.Linear, adapters: tuple[str, ...]) -> torch.Tensor:
        """The packed weight of a layer with its active adapters; packed anew if anything in it was written to."""
        parts = [linear.weight]
        for name in adapters:
            parts += [module.lora_A[name].weight, module.lora_B[name].weight]
        scales = tuple(module.scaling[name] for name in adapters)
        key = (*((p.data_ptr(), version(p)) for p in parts), *scales)
        packs = self._packed.setdefault(module, {})
        known = packs.get(adapters)
        if known is None or known.key != key:
            weight = linear.weight.detach()
            for name in adapters:
                weight = weight + module.get_delta_weight(name).detach()
            packed = torch.ops.mkldnn._reorder_linear_weight(weight)
            known = packs[adapters] = _Packed(packed, key, [p.detach() for p in parts])
        return known.weight


def version(tensor: torch.Tensor) -> int:
    """How often a tensor was written to in place, as far as torch counts: not for inference tensors, nor what fused
    optimisers write or goes through `.data`.
    """
    return 0 if tensor.is_inference() else tensor._version


def packs() -> bool:
    """Whether linear layers can multiply through oneDNN with prepacked weights."""
    # Operators that torch's own compiler uses; a build without oneDNN lacks them.
    known = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")
    return known and hasattr(torch.ops.mkldnn, "_reorder_linear_weight") and not torch.is_autocast_enabled("cpu")


def _is_plain(module: nn.Module) -> bool:
    """Nobody else (offloading, sharding) has replaced the module's forward."""
    return "forward" not in vars(module)


def mergeable(module: Any) -> tuple[nn.Linear | None, tuple[str, ...]]:
    """In float32 on a CPU, the linear layer that `module` is, or is a plain LoRA around, and the adapters to add."""
    if type(module) is nn.Linear:
        return (module if _is_float32(module.weight) else None), ()
    if not _is_lora_linear(module):
        return None, ()
    base = module.get_base_layer()
    adapters = () if module.disable_adapters or module.merged else tuple(module.active_adapters)
    adapters = tuple(name for name in adapters if name in module.lora_A)
    layers = [base, *(m[name] for name in adapters for m in (module.lora_A, module.lora_B))]
    plain = all(type(m) is nn.Linear and _is_plain(m) and not _hooked(m) and _is_float32(m.weight) for m in layers)
    variants = any(name in module.lora_variant or module.lora_B[name].bias is not None for name in adapters)
    return (base, adapters) if plain and not variants else (None, ())


def _is_lora_linear(module: nn.Module) -> bool:
    # By name, so that PEFT is not imported for models without adapters.
    kind = type(module)
    return kind.__name__ == "Linear" and kind.__module__ == "peft.tuners.lora.layer"


def _is_float32(weight: torch.Tensor) -> bool:
    return weight.dtype == torch.float32 and weight.device.type == "cpu" and type(weight.data) is torch.Tensor


def _hooked(module: nn.Module) -> bool:
    return bool(module._forward_hooks or module._forward_pre_hooks)


def _product(packed: torch.Tensor, bias: torch.Tensor | None) -> Callable[..., torch.Tensor]:
    bias = None if bias is None else bias.detach()

    def forward(x: torch.Tensor, *_: Any, **__: Any) -> torch.Tensor:
        out: torch.Tensor = torch.ops.mkldnn._linear_pointwise(x, packed, bias, "none", [], "")
        return out

    return forward


def _in_whole_vectors(function: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[torch.Tensor], torch.Tensor]:
    def forward(x: torch.Tensor) -> torch.Tensor:
        return elementwise(function, x)

    return forward


def elementwise(function: Callable[[torch.Tensor], torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """`function(x)`, each row (last dimension) computed the same way however many there are.

    The numbers are shared evenly among threads; where a share ends within a vector, the rest is computed one by one,
    with other last bits. So they are taken in pieces that are not shared, or row by row if rows end within a vector.
    """
    if x.device.type != "cpu":
        return function(x)
    width = x.shape[-1]
    share = -(-x.numel() // max(1, min(torch.get_num_threads(), -(-x.numel() // _GRAIN))))
    if width % _LANES == 0 and share % _LANES == 0:
        return function(x)
    rows = max(1, (_GRAIN - 1) // width) if width % _LANES == 0 else 1
    pieces = x.reshape(-1, width).split(rows)
    return torch.cat([function(piece) for piece in pieces]).reshape(x.shape)
