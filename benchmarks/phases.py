"""What the local engine's time goes to: reading prompts (prefill) and writing answers (decode), beside the least time.

A forward in which every row reads one token is decode; any other is prefill, whatever is written beside it. The least
time of a forward is what its products take at the machine's ceilings (`benchmarks.measuring`), or, if that is longer,
what reading all weights once takes for all its rows. Attention, keys and values, and sampling are not counted as work,
but are in the time measured.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from agentspec.llm.local.last_layer import feed_forward
from agentspec.llm.local.probe import decoder_layers
from benchmarks.measuring import Ceilings, clock


@dataclass(frozen=True)
class Work:
    """Weights that `every` token is multiplied by, those only `wanted` ones are (the last feed-forward part, the head),
    and the bytes of all.
    """

    every: int
    wanted: int
    size: int

    @classmethod
    def of(cls, model: Any) -> Work:
        """Of a transformers model, or a PEFT model around one, whose adapters are merged while it samples."""
        base = model.get_base_model() if hasattr(model, "get_base_model") else model
        layers = decoder_layers(model, int(base.config.get_text_config().num_hidden_layers))
        top = [base.get_output_embeddings(), *(feed_forward(layers[-1]) if layers is not None else [])]
        wanted = {id(m): m for part in top for m in _linear(part)}
        rest = [m for m in _linear(base) if id(m) not in wanted]
        count = sum(m.weight.numel() for m in wanted.values())
        every = sum(m.weight.numel() for m in rest)
        return cls(every, count, sum(m.weight.nbytes for m in [*wanted.values(), *rest]))

    def least(self, tokens: int, wanted: int, at: Ceilings) -> float:
        """Seconds that a forward of so many tokens, logits of `wanted` of them, takes at best."""
        return max(2 * (self.every * tokens + self.wanted * wanted) / at.flops, self.size / at.read)


def _linear(part: nn.Module) -> list[nn.Linear]:
    """Linear layers, without the factors of adapters."""
    return [m for name, m in part.named_modules() if type(m) is nn.Linear and "lora_" not in name]


@dataclass(frozen=True)
class Step:
    """One forward with the sampling after it."""

    decode: bool
    tokens: int
    wanted: int
    seconds: float
    cpu_s: float


class Phases:
    """Times every forward of a `LocalLLM` from now on."""

    def __init__(self, llm: Any) -> None:
        engine = llm._engine
        self.work = Work.of(engine.model.model)
        self.steps: list[Step] = []
        self._device: torch.device = engine.model.device
        advance = engine._advance

        def timed(step: Sequence[tuple[Any, int]]) -> None:
            wanted = sum(max(0, row.computed + n - max(row.wanted, row.computed)) for row, n in step)
            tokens = sum(n for _, n in step)
            start, used = time.perf_counter(), clock(self._device)
            advance(step)
            used = clock(self._device) - used
            self.steps.append(Step(tokens == len(step), tokens, wanted, time.perf_counter() - start, used))

        engine._advance = timed

    def summary(self, at: Ceilings) -> dict[str, dict[str, float]]:
        """Of `prefill` and `decode`, over all forwards since the last `clear`.

        `forwards`, `tokens` and `seconds` by the wall, `tokens_per_s`, `cpu_s` (processor time per thread), and
        `utilisation`: the least time over `cpu_s`.
        """
        result = {}
        for name, decode in (("prefill", False), ("decode", True)):
            steps = [s for s in self.steps if s.decode == decode]
            seconds, used = sum(s.seconds for s in steps), sum(s.cpu_s for s in steps)
            least, tokens = sum(self.work.least(s.tokens, s.wanted, at) for s in steps), sum(s.tokens for s in steps)
            result[name] = {
                "forwards": len(steps),
                "tokens": tokens,
                "seconds": seconds,
                "tokens_per_s": tokens / seconds if seconds else 0.0,
                "cpu_s": used,
                "utilisation": least / used if used else 0.0,
            }
        return result

    def clear(self) -> None:
        """Forget what was timed."""
        self.steps.clear()
