"""What the worlds of this package share: values of options, text that a space can hold, the pay for coming nearer."""

from __future__ import annotations

import functools
import re
from typing import Any

ASCII = "".join(map(chr, range(32, 127))) + "\n"
"""Printable ASCII and the newline: what observations are made of."""


def check(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Refuse a value that is not among the allowed ones.

    Raises:
        ValueError: it is not.
    """
    if value not in allowed:
        raise ValueError(f"{name} is {value!r}; expected one of {', '.join(repr(a) for a in allowed)}")


def printable(text: str, charset: str = ASCII) -> str:
    """`text` as a space of that character set holds it (messages quote what the agent wrote), `?` for all else."""
    return _others(charset).sub("?", text)


@functools.cache
def _others(charset: str) -> re.Pattern[str]:
    return re.compile(f"[^{re.escape(charset)}]")


def come_nearer(level: float, left: float, moved: float) -> float:
    """Metres that a step is paid for, either way: what the distance `left` is below `level`, at most those `moved`.

    `level` is what was paid for so far. A jump of the measured distance is paid as it is walked, and what a clip left
    out is settled by the steps after it (AllenAct's shaping): no loop earns anything.
    """
    return max(-moved, min(moved, level - left))
