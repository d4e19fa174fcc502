"""How far a batch of episodes is, and how long the rest may take: for people, and in no record."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, TextIO


def episode_progress(
    total: int, *, every_s: float = 10.0, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
) -> Callable[[Any], None]:
    """What to call after each of `total` episodes: prints `episode k/n, about 40 s left`, at most every `every_s`.

    The estimate is the mean time per episode so far, times those that are left; batches shorter than `every_s` print
    nothing.

    Args:
        total: number of episodes.
        every_s: seconds between two lines.
        stream: default: stderr.
        clock: seconds.
    """
    start = last = clock()
    done = 0

    def after(_: Any) -> None:
        nonlocal done, last
        done += 1
        now = clock()
        if now - last >= every_s and done < total:
            last = now
            rest = duration((now - start) / done * (total - done))
            print(f"  episode {done}/{total}, about {rest} left", file=stream or sys.stderr, flush=True)

    return after


def duration(seconds: float) -> str:
    """Rounded for reading.

    >>> duration(41.3), duration(200), duration(5400)
    ('41 s', '3 min', '1.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"
