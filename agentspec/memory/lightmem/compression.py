"""The stages of LightMem that need no call: which words of a text are kept, and where a topic begins.

Words are worth keeping by how surprising they are (Li et al., 2023, "selective context"): minus the logarithm of their
probability, under a unigram model of what was seen so far or under a language model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")
UNIT = 3
"""Letters of a unit (`min`, `km`, `s`) at most."""


class WordCounts:
    """A unigram model of the words seen so far, add-one smoothed.

    Args:
        most: distinct words counted; when there are more, all counts are halved and those that fall to zero forgotten.
    """

    def __init__(self, most: int = 4000) -> None:
        self.most = most
        self.counts: dict[str, int] = {}

    def add(self, words: Sequence[str]) -> None:
        """Count words."""
        for word in words:
            key = normal(word)
            self.counts[key] = self.counts.get(key, 0) + 1
        if len(self.counts) > self.most:
            self.counts = {key: n // 2 for key, n in self.counts.items() if n > 1}

    def surprisal(self, words: Sequence[str]) -> list[float]:
        """Bits of each word: -log2 of (count + 1) / (all counts + distinct words + 1)."""
        total = sum(self.counts.values()) + len(self.counts) + 1
        return [-math.log2((self.counts.get(normal(word), 0) + 1) / total) for word in words]


def normal(word: str) -> str:
    """A word as it is counted: without case and without punctuation around it."""
    return word.strip(".,;:!?()[]{}\"'").casefold()


def pieces(words: Sequence[str]) -> list[list[str]]:
    """Words that say nothing without each other: a number with the name before it, and with a short unit after it.

    >>> pieces("order 2: ready in 32 s, restaurant 4 (99.8m, -223.7m)".split())
    [['order', '2:'], ['ready'], ['in', '32', 's,'], ['restaurant', '4'], ['(99.8m,', '-223.7m)']]
    """
    found: list[list[str]] = []
    for word in words:
        last = found[-1] if found else []
        numbered = any(map(_has_digit, last))
        point = bool(last) and last[-1].startswith("(") and ")" not in last[-1]
        unit = numbered and normal(last[-1]).isdigit() and 0 < len(normal(word)) <= UNIT and not _has_digit(word)
        if last and (point or unit or (_has_digit(word) and not numbered and not word.startswith("("))):
            last.append(word)
        else:
            found.append([word])
    return found


def _has_digit(word: str) -> bool:
    return any(sign.isdigit() for sign in word)


def keep_surprising(words: Sequence[T], surprisal: Sequence[float], rate: float) -> list[T]:
    """The most surprising words in their order: max(1, floor(rate * n)) of n; of equals the earlier ones.

    >>> keep_surprising(["the", "mill", "is", "open"], [0.1, 3.0, 0.2, 2.0], 0.5)
    ['mill', 'open']
    """
    if not words:
        return []
    count = max(1, math.floor(rate * len(words) + 1e-9))
    best = sorted(range(len(words)), key=lambda i: (-surprisal[i], i))[:count]
    return [words[i] for i in sorted(best)]


def boundaries(similarity: Sequence[float], lowest: float = 0.2, step: float = 0.05, highest: float = 0.5) -> list[int]:
    """Where topics begin, from the similarity of neighbouring turns.

    A turn begins a topic if it is less similar to the turn before than a threshold; the threshold rises from `lowest`
    by `step` until there is such a turn, to `highest` at most.

    Args:
        similarity: of turns 0 and 1, 1 and 2, ...; shape (turns - 1,).

    Returns:
        Numbers of the turns that begin a topic (never 0); empty if all are alike.

    >>> boundaries([0.9, 0.3, 0.8]), boundaries([0.9, 0.8])
    ([2], [])
    """
    for i in range(math.floor((highest - lowest) / step + 1e-9) + 1):
        found = [turn for turn, value in enumerate(similarity, start=1) if value < lowest + i * step]
        if found:
            return found
    return []
