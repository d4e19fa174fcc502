"""Keys and values of token sequences the model has already read, found again by prefix.

A :class:`Slot` holds the keys and values of one token sequence, per layer, in buffers that grow in place. The
:class:`PrefixCache` keeps the slots of finished calls. A new prompt looks for the longest common prefix with any of
them:

- its own episode's slot is *continued in place* when it is a prefix of the prompt, or nearly so;
- any other slot (the same static prompt in another episode, another module's view of this episode) is *copied* up to
  the common prefix. Copying a token costs about a hundredth of computing it.

The least recently used slots go first when the bound on tokens is passed, which running calls count towards. Adapters
share the bound, and nothing else: keys and values that one adapter computed are never found by another.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from agentspec.llm.local.states import Pieces, up_to

_GROWTH = 1.25
_BONUS = 16


class Slot:
    """Keys and values of ``tokens[:length]``.

    ``keys[layer]`` and ``values[layer]`` are buffers of shape (key-value heads, capacity, head size), allocated when a
    layer first writes; only the first ``length`` positions are meaningful, the others are finite. ``capacity`` is a
    multiple of ``block``.
    """

    __slots__ = ("adapter", "block", "capacity", "epoch", "keys", "length", "owner", "seen", "tokens", "used", "values")

    def __init__(self, layers: int, capacity: int, block: int = 64) -> None:
        self.keys: list[torch.Tensor | None] = [None] * layers
        self.values: list[torch.Tensor | None] = [None] * layers
        self.block = block
        self.capacity = _round_up(capacity, block)
        self.length = 0
        self.tokens = np.empty(0, np.int32)
        self.seen: Pieces = []
        self.owner: str | None = None
        self.adapter = ""
        self.epoch = 0
        self.used = 0

    def reserve(self, capacity: int) -> None:
        """Make room for ``capacity`` positions, keeping the first ``length``; grows by a quarter at least."""
        if capacity <= self.capacity:
            return
        self.capacity = _round_up(max(capacity, int(self.capacity * _GROWTH)), self.block)
        for buffers in (self.keys, self.values):
            for i, old in enumerate(buffers):
                if old is not None:
                    new = old.new_zeros(old.shape[0], self.capacity, old.shape[2])
                    new[:, : self.length] = old[:, : self.length]
                    buffers[i] = new

    def write(self, layer: int, start: int, key: torch.Tensor, value: torch.Tensor) -> None:
        """Put keys and values of shape (heads, n, size) at positions ``start ... start + n - 1``."""
        keys, values = self._buffers(layer, key, value)
        keys[:, start : start + key.shape[1]] = key
        values[:, start : start + key.shape[1]] = value

    def layer(self, layer: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Keys and values of one layer that has written."""
        keys, values = self.keys[layer], self.values[layer]
        assert keys is not None and values is not None
        return keys, values

    def copy_layer(self, layer: int, source: Slot, start: int, stop: int) -> None:
        """Take positions ``start ... stop - 1`` of one layer from ``source``."""
        key, value = source.keys[layer], source.values[layer]
        if key is not None and value is not None:
            self.write(layer, start, key[:, start:stop], value[:, start:stop])

    def copy_prefix(self, source: Slot, length: int) -> None:
        """Become the first ``length`` positions of ``source``."""
        self.reserve(length)
        for layer in range(len(source.keys)):
            self.copy_layer(layer, source, 0, length)
        self.seen = up_to(source.seen, length)
        self.length = length

    def _buffers(self, layer: int, key: torch.Tensor, value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        keys, values = self.keys[layer], self.values[layer]
        if keys is None or values is None:
            keys = self.keys[layer] = key.new_zeros(key.shape[0], self.capacity, key.shape[2])
            values = self.values[layer] = value.new_zeros(value.shape[0], self.capacity, value.shape[2])
        return keys, values


@dataclass
class Match:
    """The cached slot that shares the longest prefix with a prompt, and how many tokens that is."""

    slot: Slot | None = None
    length: int = 0


class PrefixCache:
    """Slots of finished calls, found by prefix; with those of running calls they hold ``max_tokens`` positions at most,
    as long as the running ones leave room. A slot's capacity is a multiple of ``block``.
    """

    def __init__(self, layers: int, max_tokens: int, block: int = 64) -> None:
        self.layers = layers
        self.block = block
        self.max_tokens = max_tokens
        self._slots: list[Slot] = []
        self._running: set[Slot] = set()
        self._clock = 0
        self._epoch = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def tokens(self) -> int:
        """Positions held: the capacity of all slots, those of running calls among them."""
        return self.running + sum(s.capacity for s in self._slots)

    @property
    def running(self) -> int:
        """Positions that running calls hold."""
        return sum(s.capacity for s in self._running)

    def clear(self) -> None:
        """Forget everything, also what calls that are running now will bring back: the weights changed."""
        with self._lock:
            self._slots.clear()
            self._epoch += 1

    def release(self, owner: str) -> None:
        """The episode ended: its slots may be continued or overwritten by anyone."""
        with self._lock:
            for slot in self._slots:
                if slot.owner == owner:
                    slot.owner = None

    def assign(self, prompts: Sequence[tuple[Sequence[int], int, str, int]], adapter: str = "") -> list[Slot]:
        """One slot per row, with the longest known prefix in place; each comes back by `put` or `drop`.

        Args:
            prompts: per row the tokens, the longest prefix that may be reused, the episode, and the capacity needed.
            adapter: the adapter that computes them.

        Returns:
            Slots, no longer in the cache, in the order of the rows.
        """
        with self._lock:
            self._clock += 1
            arrays = [np.asarray(tokens[:limit], np.int32) for tokens, limit, _, _ in prompts]
            # All are matched before any slot is taken, and all copies are made before any slot is written.
            matches = [self._match(a, owner, adapter) for a, (_, _, owner, _) in zip(arrays, prompts, strict=True)]
            taken: dict[int, Slot] = {}
            for i, (match, (_, _, owner, _)) in enumerate(zip(matches, prompts, strict=True)):
                slot = match.slot
                if slot is not None and slot not in taken.values() and self._may_continue(slot, match.length, owner):
                    taken[i] = slot
            # Others make room first; those that are copied from were matched just now and go last.
            self._trim(sum(_round_up(p[3], self.block) for i, p in enumerate(prompts) if i not in taken))
            found: list[Slot] = []
            for i, (match, (_, _, _, capacity)) in enumerate(zip(matches, prompts, strict=True)):
                slot = taken.get(i) or Slot(self.layers, capacity, self.block)
                if i not in taken and match.slot is not None:
                    slot.copy_prefix(match.slot, match.length)
                found.append(slot)
            for i, slot in taken.items():
                if slot in self._slots:
                    self._slots.remove(slot)
                slot.length = matches[i].length
            for slot, (_, _, owner, capacity) in zip(found, prompts, strict=True):
                slot.reserve(capacity)
                slot.owner, slot.adapter, slot.epoch = owner, adapter, self._epoch
            self._running.update(found)
            self._trim()
            return found

    def put(self, slot: Slot, tokens: Sequence[int]) -> None:
        """Keep a slot; ``tokens`` are those whose keys and values it holds."""
        with self._lock:
            self._running.discard(slot)
            if slot.epoch != self._epoch or not tokens:
                return
            slot.length = len(tokens)
            slot.tokens = np.asarray(tokens, np.int32)
            self._clock += 1
            slot.used = self._clock
            self._slots.append(slot)
            self._trim()

    def drop(self, slot: Slot) -> None:
        """A slot that is not kept."""
        with self._lock:
            self._running.discard(slot)

    def drop_running(self) -> None:
        """No call runs any more."""
        with self._lock:
            self._running.clear()

    def trim(self) -> None:
        """Hold the bound: running calls may have grown."""
        with self._lock:
            self._trim()

    def _match(self, prompt: np.ndarray, owner: str, adapter: str) -> Match:
        best, rank = Match(), (0, 0)
        for slot in self._slots:
            if slot.adapter != adapter:
                continue
            length = common_prefix(slot.tokens, prompt)
            # A slot that may be continued is worth a few tokens: it saves a copy and the memory of another slot.
            bonus = _BONUS if self._may_continue(slot, length, owner) else 0
            candidate = (length + bonus, -slot.length)
            if length and (best.slot is None or candidate > rank):
                best, rank = Match(slot, length), candidate
        if best.slot is not None:
            best.slot.used = self._clock
        return best

    def _may_continue(self, slot: Slot, length: int, owner: str) -> bool:
        """In place only if it costs no other live episode its context, and this one not most of a longer context."""
        return slot.owner in (None, owner) and slot.length - length <= length

    def _trim(self, more: int = 0) -> None:
        """Forget the least recently used, so that ``more`` positions have room."""
        total = self.tokens + more
        if total <= self.max_tokens:
            return
        for slot in sorted(self._slots, key=lambda s: s.used):
            if total <= self.max_tokens:
                return
            self._slots.remove(slot)
            total -= slot.capacity


def common_prefix(a: np.ndarray, b: np.ndarray) -> int:
    """Length of the longest common prefix of two integer arrays."""
    n = min(len(a), len(b))
    if n == 0:
        return 0
    differs = a[:n] != b[:n]
    first = int(differs.argmax())
    return first if differs[first] else n


def _round_up(n: int, block: int) -> int:
    return -(-n // block) * block
