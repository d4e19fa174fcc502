"""Tokens: what two sequences have in common, and text within a budget of them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence

CUT = " ..."
"""What stands where text was cut off."""

_PARTS = re.compile(r"\n\s*\n| \| ")
_LEAST = 8

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


def news(text: str, before: str, told: str = "") -> str:
    """What an observation says that the one before it did not: the lines that a line-by-line difference adds.

    A line is left out too if all it says, after its label, is what was `told` of the action between them.

    >>> news("Find it.\\nLast: turned left.\\nIn front: a wall.", "Find it.\\nIn front: nothing.", "turned left")
    'In front: a wall.'
    >>> news("Not done.", "", "done"), news("- apple\\n- apple", "- apple")
    ('Not done.', '- apple')
    """
    old, new = before.splitlines(), text.splitlines()
    again = told.strip().rstrip(".")
    steps = difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes()
    lines = [line for kind, _, _, begin, end in steps if kind != "equal" for line in new[begin:end]]
    if again:
        lines = [line for line in lines if line.rpartition(": ")[2].strip().rstrip(".") != again]
    return "\n".join(lines).strip()


def excerpt(text: str, budget: int, count_tokens: CountTokens = estimate_tokens) -> str:
    """An observation on one line within `budget`: its paragraphs, of which the long ones are clipped.

    The room goes to the paragraphs in proportion 1, 1/2, 1/3, ...: so the beginning is longest, but what follows it
    (orders, what is carried) is there too. Short ones stay whole; one that would get less than 8 tokens is left out.

    >>> excerpt("a long beginning, too long for the room\\n\\nOrders: 7, 9\\n\\nHere: nobody", 62, len)
    'a long beginning, too long f ... | Orders: 7, 9 | Here ...'
    """
    parts = [" ".join(part.split()) for part in _PARTS.split(text)]
    parts = [part for part in parts if part]
    joined = " | ".join(parts)
    if len(parts) < 2 or count_tokens(joined) <= budget:
        return clip_text(joined, budget, count_tokens)
    costs = [count_tokens(part) + count_tokens(" | ") for part in parts]
    candidates = list(range(len(parts)))
    while candidates:
        shares = _shares(costs, candidates, budget)
        clipped = [i for i in candidates if costs[i] > shares[i]]
        if not clipped or shares[clipped[-1]] >= _LEAST + count_tokens(" | "):
            break
        candidates.remove(clipped[-1])
    shown = [clip_text(parts[i], int(shares[i]) - count_tokens(" | "), count_tokens) for i in candidates]
    return clip_text(" | ".join(filter(None, shown)) or joined, budget, count_tokens)


def _shares(costs: Sequence[int], among: Sequence[int], budget: int) -> dict[int, float]:
    """The room of each: what it costs if that is less than its share of what the others leave, else that share."""
    shares: dict[int, float] = {}
    waiting, left = list(among), float(budget)
    while waiting:
        unit = left / sum(1 / (i + 1) for i in waiting)
        small = [i for i in waiting if costs[i] <= unit / (i + 1)]
        if not small:
            return shares | {i: unit / (i + 1) for i in waiting}
        for i in small:
            shares[i] = costs[i]
            left -= costs[i]
            waiting.remove(i)
    return shares
