"""What went into one layer for every token that calls have read: kept for whoever would compute it again.

A trainer whose lower layers are frozen starts its updates there. Like keys and values, a token's
states depend on the tokens before it only: pieces of them stand with a `Slot` and go where its positions go; when a
call ends, they are found by its tokens.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from agentspec.tokens import shared_prefix

if TYPE_CHECKING:
    from agentspec.llm.local.attention import Segment

Pieces = list[tuple[int, torch.Tensor]]
"""First position and states (n, hidden) of consecutive positions, in order, none twice."""


def up_to(pieces: Pieces, length: int) -> Pieces:
    """The pieces of the first `length` positions."""
    return [(start, states[: length - start]) for start, states in pieces if start < length]


class StateRecorder:
    """Records what goes into `layer` while the engine runs, in the order of positions.

    Args:
        layer: a decoder layer.
        limit: bytes; calls of more in all are forgotten until `clear`, which does not depend on who came first.
    """

    def __init__(self, layer: nn.Module, limit: int = 1 << 30) -> None:
        self._layer = layer
        self._limit = limit
        self._seen: torch.Tensor | None = None
        self.clear()

    def clear(self) -> None:
        """Forget all calls."""
        self._calls: dict[bytes, Pieces] = {}
        self._last: dict[str, list[int]] = {}
        self._bytes = 0

    def find(self, tokens: Sequence[int]) -> torch.Tensor | None:
        """States (n, hidden) of the n `tokens`, if a call has read exactly these."""
        pieces = self._calls.get(_key(tokens)) if self._bytes <= self._limit else None
        return torch.cat([states for _, states in pieces]) if pieces else None

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Forwards inside are seen."""

        def see(_: nn.Module, inputs: tuple[Any, ...]) -> None:
            self._seen = inputs[0][0]

        handle = self._layer.register_forward_pre_hook(see)
        try:
            yield
        finally:
            handle.remove()
            self._seen = None

    def note(self, segments: Sequence[Segment], bounds: Sequence[tuple[int, int]]) -> None:
        """Put what the last forward has seen with the slots of its segments."""
        if self._seen is None or self._bytes > self._limit:
            return
        for segment, (begin, end) in zip(segments, bounds, strict=True):
            if segment.source is not None:
                segment.slot.seen = up_to(segment.source.seen, segment.start)
            pieces = segment.slot.seen
            while pieces and pieces[-1][0] >= segment.start:  # written over
                pieces.pop()
            if pieces:
                start, states = pieces[-1]
                pieces[-1] = start, states[: segment.start - start]
            pieces.append((segment.start, self._seen[begin:end]))

    def keep(self, episode: str, tokens: list[int], pieces: Pieces) -> None:
        """A call of `episode` has ended that read `tokens`."""
        if not pieces or self._bytes > self._limit:
            return
        row = pieces[0][1].shape[-1] * pieces[0][1].element_size()
        self._bytes += row * (len(tokens) - shared_prefix(self._last.get(episode, []), tokens))
        self._last[episode] = tokens
        if self._bytes > self._limit:
            self._calls.clear()
        elif sum(len(states) for _, states in pieces) == len(tokens):  # none from before the recorder
            self._calls[_key(tokens)] = list(pieces)


def _key(tokens: Sequence[int]) -> bytes:
    return np.asarray(tokens, np.int32).tobytes()
