"""Tokens: what two sequences have in common, and text within a budget of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

CUT = " ..."
"""What stands where text was cut off."""

CountTokens = Callable[[str], int]


def shared_prefix(a: Sequence[int], b: Sequence[int], start: int = 0, stop: int | None = None) -> int:
    """Length of the longest common prefix, by bisection over slices (each compared in C).

    Args:
        a: tokens, of the same kind as `b`: two lists or two tuples.
        b: tokens.
        start: they are known to agree up to here.
        stop: look no further than this.

    >>> shared_prefix([1, 2, 3], [1, 2, 4, 5])
    2
    """
    low, high = start, min(len(a), len(b))
    if stop is not None:
        high = min(high, stop)
    if a[low:high] == b[low:high]:
        return high
    while low < high:
        middle = (low + high + 1) // 2
        if a[low:middle] == b[low:middle]:
            low = middle
        else:
            high = middle - 1
    return low


def estimate_tokens(text: str) -> int:
    """About how many tokens a text has: one for every four characters, and one.

    >>> estimate_tokens("12345678")
    3
    """
    return len(text) // 4 + 1


def clip_text(text: str, budget: int, count_tokens: CountTokens = estimate_tokens) -> str:
    """The text if it has at most `budget` tokens, else its beginning with a mark where it was cut; `""` if not even
    the mark fits.

    >>> clip_text("abcdefghij", 8, len)
    'abcd ...'
    """
    if count_tokens(text) <= budget:
        return text
    low, high = 0, len(text)
    while low < high:
        middle = (low + high + 1) // 2
        if count_tokens(text[:middle].rstrip() + CUT) <= budget:
            low = middle
        else:
            high = middle - 1
    return text[:low].rstrip() + CUT if low else ""
