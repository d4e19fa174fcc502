"""The packed forward pass: many sequences, one row of tokens, no padding.

The new tokens of all sequences stand side by side in one row of shape (1, T) with their own position ids. Everything
in a decoder except attention works on single tokens and does not notice. Attention is ours: it is registered with
transformers as one more attention function, stores the new keys and values in the sequences' slots, and lets each
segment look at its own slot only. So a batch of unequal prompts costs exactly its new tokens, a prefix that sequences
of one batch share is computed once and copied, and reading a prompt, decoding and forced runs of tokens are the same
operation.

What a segment's logits are does not depend on what else is in the row, but for rounding; on CPUs not even by that
(`agentspec.llm.local.invariance`; `PackedModel.invariant` tries it out).

It works with every decoder that uses the attention interface of transformers, whatever its weights (float types, LoRA
adapters); `PackedModel.check` compares it with the model's ordinary forward before its first use.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import nn

from agentspec.llm.base import LLMError
from agentspec.llm.local.adapters import active_adapter, using
from agentspec.llm.local.attention import Pack, Segment, active, packed_attention
from agentspec.llm.local.blocks import WHOLE, last_blocks, padded
from agentspec.llm.local.cache import Slot
from agentspec.llm.local.invariance import MIN_ROWS, InvariantModules
from agentspec.llm.local.last_layer import feed_forward, only_at
from agentspec.llm.local.probe import decoder_layers, is_batch_invariant
from agentspec.llm.local.states import StateRecorder

_ATTENTION = "agentspec_packed"
_LAYER_TYPES = frozenset({"full_attention", "sliding_attention", "attention"})
_MIN_ROWS = {"cpu": MIN_ROWS}
_MULTIPLE = 8
"""On a CPU, tokens of a longer forward are filled up to a multiple of this: oneDNN compiles and keeps a product for
every number of rows (SmolLM2: 3 MB and 3 ms).
"""


class PackedModel:
    """A live transformers model behind `forward`; it is never moved, cast or left changed.

    Raises:
        LLMError: the architecture cannot be driven by position ids, or keeps a state other than keys and values.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        base = model.get_base_model() if hasattr(model, "get_base_model") else model
        self.config = base.config
        parameters = inspect.signature(base.forward).parameters
        text = self.config.get_text_config() if hasattr(self.config, "get_text_config") else self.config
        other = set(getattr(text, "layer_types", None) or ()) - _LAYER_TYPES
        if "position_ids" not in parameters or getattr(base, "_is_stateful", False) or other:
            raise LLMError(
                f"{type(base).__name__} cannot run in the local backend: it has no position ids, keeps a recurrent "
                f"state, or has layers other than full and sliding attention ({sorted(other) or 'none named'}); serve "
                "it (vLLM) and use the `openai` backend"
            )
        self.text_config = text
        self.layers = int(text.num_hidden_layers)
        self.max_context = int(getattr(text, "max_position_embeddings", None) or 1 << 30)
        self._keeps = "logits_to_keep" in parameters
        self.recorder: StateRecorder | None = None
        self._modules = InvariantModules(model)
        self._checked = False
        self._whole_blocks = False
        self._above: list[nn.Module] = []
        self._invariant: tuple[int, bool] | None = None

    @property
    def device(self) -> torch.device:
        """Where the model is now."""
        return next(self.model.parameters()).device

    @property
    def last_blocks(self) -> tuple[int, ...]:
        """Lengths that the last block of keys may have (`agentspec.llm.local.blocks`); empty: any."""
        if self.device.type != "cpu":
            return ()
        text = self.text_config
        size = getattr(text, "head_dim", None) or text.hidden_size // text.num_attention_heads
        return (WHOLE,) if self._whole_blocks else last_blocks(int(size), torch.get_num_threads())

    def room(self, tokens: int) -> int:
        """Positions that a slot needs to hold and attend to so many ``tokens``."""
        return padded(tokens, last) if (last := self.last_blocks) else tokens

    def forward(self, segments: Sequence[Segment]) -> list[torch.Tensor]:
        """Run all segments, in order; per segment the float32 logits of its last ``logits`` positions, (logits, V).

        Slots are extended (``length``) by what was computed. Call inside `session` and `adapter`.
        """
        device, last = self.device, self.last_blocks
        bounds: list[tuple[int, int]] = []
        tokens: list[int] = []
        positions: list[int] = []
        wanted: list[int] = []
        for s in segments:
            stop = s.start + len(s.tokens)
            s.slot.reserve(padded(stop, last) if last else stop)
            begin = len(tokens)
            tokens.extend(s.tokens)
            positions.extend(range(s.start, s.start + len(s.tokens)))
            bounds.append((begin, len(tokens)))
            wanted.extend(range(len(tokens) - s.logits, len(tokens)))
        padding = [0] * (_rows(len(tokens), device) - len(tokens))
        ids = torch.tensor([tokens + padding], device=device)
        # The head must compute something, even if nothing is wanted.
        keep = torch.tensor(wanted + [0] * (_rows(len(wanted), device) - len(wanted)), device=device)
        arguments = {"logits_to_keep": keep} if self._keeps else {}
        with active(Pack(segments, bounds, last)), only_at(self._above, keep, ids.shape[1]):
            out = self.model(
                input_ids=ids,
                position_ids=torch.tensor([positions + padding], device=device),
                use_cache=False,
                return_dict=True,
                **arguments,
            )
        for s in segments:
            s.slot.length = s.start + len(s.tokens)
        if self.recorder is not None:
            self.recorder.note(segments, bounds)
        logits = out.logits[0] if self._keeps else out.logits[0][keep]
        return list(logits[: len(wanted)].float().split([s.logits for s in segments]))

    @contextmanager
    def session(self) -> Iterator[None]:
        """Evaluation mode, no gradients, our attention; everything as before at the end."""
        _register()
        layers = decoder_layers(self.model, self.layers)
        self._above = feed_forward(layers[-1]) if layers is not None else []
        configs = {}
        for module in self.model.modules():
            config: Any = getattr(module, "config", None)
            if hasattr(config, "_attn_implementation_internal"):
                configs[id(config)] = (config, config._attn_implementation_internal)
        with _evaluating(self.model), self.recorder.watching() if self.recorder else nullcontext():
            try:
                for config, _ in configs.values():
                    config._attn_implementation_internal = _ATTENTION
                yield
            finally:
                for config, implementation in configs.values():
                    config._attn_implementation_internal = implementation

    @contextmanager
    def adapter(self, name: str) -> Iterator[None]:
        """Adapter `name` (`""`: the active one) answers inside, by products that do not depend on the batch."""
        with using(self.model, name or active_adapter(self.model)), self._modules.in_use():
            yield

    def invalidate(self) -> None:
        """Forget packed weights: they changed in a way that their versions do not tell."""
        self._modules.clear()

    def check(self) -> None:
        """Compare the packed forward with the model's own on a few tokens, once.

        Raises:
            LLMError: they differ: the architecture does something the packed forward does not know.
        """
        if self._checked:
            return
        vocabulary = int(self.model.get_input_embeddings().weight.shape[0])
        tokens = [(7 * i * i + 3 * i + 1) % vocabulary for i in range(12)]
        with self.session(), self.adapter(""):
            slots = [Slot(self.layers, 16) for _ in range(2)]
            packed = [
                self.forward([Segment(slots[0], tokens[:5], 0)]),
                # The rest of the first, packed beside a second sequence that copies its beginning.
                self.forward([Segment(slots[0], tokens[5:], 5), Segment(slots[1], tokens[8:], 8, source=slots[0])]),
            ]
        with _evaluating(self.model):
            plain = self.model(input_ids=torch.tensor([tokens], device=self.device), use_cache=False).logits[0].float()
        expected = torch.stack([plain[4], plain[11], plain[11]])
        got = torch.cat([packed[0][0], *packed[1]])
        scale = (expected - expected.mean(-1, keepdim=True)).norm()
        error = float((got - expected).norm() / scale)
        exact = next(self.model.parameters()).dtype == torch.float32
        exact &= torch.get_float32_matmul_precision() == "highest"
        limit = 1e-3 if exact else 0.1
        if not error <= limit:
            raise LLMError(
                f"the local backend does not compute {type(self.model).__name__} ({self.config.model_type}) correctly: "
                f"its logits differ by {error:.2g} of their size from the model's own (at most {limit:g} is rounding); "
                "serve the model (vLLM) and use the `openai` backend"
            )
        self._checked = True

    def invariant(self) -> bool:
        """Whether a token's logits are the same, to the last bit, however many others are computed with it.

        Tried out (`agentspec.llm.local.probe`) once for each architecture and number of threads in a process.
        """
        threads = torch.get_num_threads()
        if self._invariant is None or self._invariant[0] != threads:
            self.check()
            self._whole_blocks = False
            found = is_batch_invariant(self)
            if not found and self.device.type == "cpu":
                self._whole_blocks = True
                found = is_batch_invariant(self)
            self._invariant = threads, found
        return self._invariant[1]


def _rows(wanted: int, device: torch.device) -> int:
    """Rows of a product that has to be made for so many tokens."""
    least = _MIN_ROWS.get(device.type, 1)
    if device.type != "cpu" or wanted <= least:
        return least if wanted < least else wanted
    return -(-wanted // _MULTIPLE) * _MULTIPLE


@contextmanager
def _evaluating(model: Any) -> Iterator[None]:
    """No gradients, and every module in evaluation mode (which also turns gradient checkpointing off)."""
    training = [m for m in model.modules() if m.training]
    for module in training:
        module.training = False
    try:
        with torch.no_grad():
            yield
    finally:
        for module in training:
            module.training = True


def _register() -> None:
    from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS

    if _ATTENTION not in ALL_ATTENTION_FUNCTIONS:
        # No mask function is registered with it, so that transformers builds no (T, T) mask.
        ALL_ATTENTION_FUNCTIONS.register(_ATTENTION, packed_attention)
