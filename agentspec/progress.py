"""How far a batch of episodes is, or a model with its prompts, and how long the rest may take.

For people, and in no record.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from agentspec.llm.base import LLM
    from agentspec.policies import Policy


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


def model_progress(
    *, every_s: float = 15.0, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
) -> Callable[[int, int], None]:
    """What a local model tells before every forward (`agentspec.llm.local.engine.Watch`).

    The first prompt is announced at once; later only what takes longer than `every_s` says something.

    Args:
        every_s: seconds between two lines.
        stream: default: stderr.
        clock: seconds.
    """
    last, begun = -math.inf, clock()
    most = left = 0

    def before(reading: int, written: int) -> None:
        nonlocal last, begun, most, left
        now = clock()
        if reading > left:  # other prompts
            begun, most = now, reading
        left = reading
        if now - last < every_s:
            return
        read = most - reading
        if reading and read and now > begun:
            speed = read / (now - begun)
            line = f"read {read:,} of {most:,} tokens, {speed:,.1f} tokens/s, about {duration(reading / speed)} left"
        elif reading:
            line = f"reading a prompt of {reading:,} tokens ..."
        else:
            line = f"{written:,} tokens written so far ..."
        last = now
        print(f"  {line}", file=stream or sys.stderr, flush=True)

    return before


def load_policy(policy: Policy, stream: TextIO | None = None) -> LLM | None:
    """The policy's backend, loaded; says so, and lets a local model tell how far it is."""
    loads = not policy.scripted and policy.settings()["backend"] in ("local", "vision")
    began = time.monotonic()
    if loads:
        print(f"loading {policy.name} ...", file=stream or sys.stderr, flush=True)
    llm = policy.build()
    if loads:
        took = duration(time.monotonic() - began)
        print(f"{policy.name} loaded in {took}", file=stream or sys.stderr, flush=True)
    watch = getattr(llm, "watch", None)
    if callable(watch):
        watch(model_progress(stream=stream))
    return llm


def duration(seconds: float) -> str:
    """Rounded for reading.

    >>> duration(41.3), duration(200), duration(5400)
    ('41 s', '3 min', '1.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"
