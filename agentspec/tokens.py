"""Token sequences: what two of them have in common."""

from __future__ import annotations

from collections.abc import Sequence


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
