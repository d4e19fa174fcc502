"""Reading a judge's verdict: one of a few words, or a number."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

_INTEGER = re.compile(r"(?<![\d.])\d+(?![\d.]*\d)")


def last_word(text: str, values: Mapping[str, float]) -> float | None:
    """The value of the known word that stands last in ``text``, whatever its case; ``None`` if none does."""
    pattern = r"\b(" + "|".join(re.escape(w) for w in values) + r")\b"
    found = re.findall(pattern, text.casefold())
    return values[found[-1]] if found else None


def last_number(text: str, allowed: Sequence[int]) -> int | None:
    """The last whole number of ``text`` that is among ``allowed``; ``None`` if there is none."""
    found = [int(m) for m in _INTEGER.findall(text[:10_000]) if len(m) < 10]
    fitting = [n for n in found if n in allowed]
    return fitting[-1] if fitting else None
