"""Patterns over the tags of model calls: which calls are trained, routed to an adapter, or answered by a helper."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase


def matches(path: str, patterns: str | Iterable[str]) -> bool:
    """Whether a tag's path (`module/purpose`) fits a shell pattern, or one of several.

    A pattern without `/` speaks of modules and fits any purpose.

    >>> matches("reasoning.react/act", "reasoning.*"), matches("memory.summary/summary", ["*/act", "*/write"])
    (True, False)
    """
    several = (patterns,) if isinstance(patterns, str) else patterns
    return any(fnmatchcase(path, p if "/" in p else f"{p}/*") for p in several)
