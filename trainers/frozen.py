"""Frozen layers: what no update can change is computed once per token and round, and every forward starts above it.

Where LoRA sits on the upper layers, what comes out of the layers below depends on a token and those before it, not on
the weights under training. The rollouts have computed it (`agentspec.llm.local.states`), or it is computed once for the
rows of a round (`trainers.forward.frozen_output`); updates, further epochs and the reference start from there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from trainers.sequences import TokenSequence

LIMIT = 1 << 30
"""Bytes of frozen output kept for a round; rows beyond them are computed from their first layer."""


@contextmanager
def replaced(forwards: Mapping[nn.Module, Callable[..., Any]]) -> Iterator[None]:
    """Inside, each module's forward is the one given."""
    before = {module: vars(module).get("forward") for module in forwards}
    try:
        for module, forward in forwards.items():
            module.forward = forward
        yield
    finally:
        for module, own in before.items():
            if own is None:
                del module.forward  # the class's is seen again
            else:
                module.forward = own


def unchanged(states: torch.Tensor, *_: Any, **__: Any) -> torch.Tensor:
    """The forward of a layer that is passed over."""
    return states


def language_model(model: Any) -> Any:
    """The transformers model that `model` is, or that PEFT is around; its decoder is `.base_model`."""
    return model.get_base_model() if hasattr(model, "get_base_model") else model


def frozen_layers(model: nn.Module) -> list[nn.Module]:
    """The leading decoder layers that hold no adapter and nothing to train.

    None if nothing above them is trained, if anything outside the layers is (the embeddings come before them), or if
    the architecture cannot start above them (tried out on a few tokens).
    """
    base = language_model(model)
    layers = list(getattr(base.base_model, "layers", ()))
    inside = {module for layer in layers for module in layer.modules()}
    changed = [any(map(_may_change, layer.modules())) for layer in layers]
    if True not in changed or any(_may_change(m) for m in base.modules() if m not in inside):
        return []
    frozen = layers[: changed.index(True)]
    return frozen if frozen and _can_start_above(base, frozen) else []


def layer_above(model: nn.Module, layers: Sequence[nn.Module]) -> nn.Module:
    """The first decoder layer above the frozen ones."""
    above: nn.Module = language_model(model).base_model.layers[len(layers)]
    return above


def _may_change(module: nn.Module) -> bool:
    """Whether it holds an adapter (of any name: one may be switched on) or a weight under training."""
    return type(module).__module__.startswith("peft.") or any(p.requires_grad for p in module.parameters(False))


def _can_start_above(base: Any, layers: Sequence[nn.Module]) -> bool:
    if not hasattr(base.base_model, "norm"):
        return False
    weights = base.get_input_embeddings().weight
    inputs = {"input_ids": torch.arange(12, device=weights.device)[None] % weights.shape[0]}
    with torch.no_grad():
        whole = base.base_model(**inputs, use_cache=False).last_hidden_state
        try:
            states = output_of(base.base_model, layers, **inputs)
            with replaced(dict.fromkeys(layers, lambda *_, **__: states)):
                above = base.base_model(**inputs, use_cache=False).last_hidden_state
        except Exception:  # whatever a layer raises that is called in another way
            return False
    return bool(torch.allclose(above, whole, rtol=1e-3, atol=1e-4))


def output_of(decoder: Any, layers: Sequence[nn.Module], **inputs: Any) -> torch.Tensor:
    """What comes out of the leading `layers` of a decoder for its usual `inputs`: (B, L, hidden), without gradient."""
    above = [*decoder.layers[len(layers) :], decoder.norm]
    with torch.no_grad(), replaced(dict.fromkeys(above, unchanged)):
        states: torch.Tensor = decoder(**inputs, use_cache=False).last_hidden_state
    return states


@dataclass
class FrozenOutput:
    """What comes out of a policy's frozen `layers` for the rows of a round.

    Args:
        layers: those that are passed over.
        states: (N, hidden), one row per distinct token prefix.
    """

    layers: Sequence[nn.Module]
    states: torch.Tensor
    _places: dict[int, tuple[TokenSequence, torch.Tensor]] = field(default_factory=dict)

    def add(self, sequence: TokenSequence, places: Sequence[int]) -> None:
        """`states[places[p]]` is the output for token p of `sequence`."""
        self._places[id(sequence)] = sequence, torch.tensor(places)  # held, so that the id stays its own

    @contextmanager
    def given(
        self, sequences: Sequence[TokenSequence], places: Sequence[Sequence[int]], shape: tuple[int, int]
    ) -> Iterator[None]:
        """Forwards inside start above the frozen layers; nothing changes if a sequence is not known.

        Args:
            places: per sequence, where in a forward of `shape` (B, L), flattened, its tokens are.
        """
        if any(id(s) not in self._places for s in sequences):
            yield
            return
        index = torch.zeros(shape[0] * shape[1], dtype=torch.long)
        for sequence, here in zip(sequences, places, strict=True):
            index[torch.tensor(here)] = self._places[id(sequence)][1][: len(here)]
        states = self.states[index.view(shape).to(self.states.device)]

        def start(hidden: torch.Tensor, *_: Any, **__: Any) -> torch.Tensor:
            return states.requires_grad_(hidden.requires_grad)  # which re-entrant checkpoints need

        with replaced(dict.fromkeys(self.layers, start)):
            yield
