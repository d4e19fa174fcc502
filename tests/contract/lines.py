"""Which lines of a module's functions run: a line tracer for one file, without a dependency."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

NEW_LOCALS = 0x2
"""Flag of the code of functions, which that of modules and class bodies lacks."""


def _codes(code: CodeType) -> list[CodeType]:
    return [c for c in code.co_consts if isinstance(c, CodeType)]


def function_lines(path: Path) -> set[int]:
    """The lines of a file's functions that can run; `def` lines and docstrings are none.

    Public functions beside the classes serve other modules and have tests of their own: they do not count.
    """
    module = compile(path.read_text(encoding="utf-8"), str(path), "exec")
    stack = [c for c in _codes(module) if not c.co_flags & NEW_LOCALS or c.co_name.startswith(("_", "<"))]
    lines: set[int] = set()
    while stack:
        code = stack.pop()
        stack += _codes(code)
        if code.co_flags & NEW_LOCALS:
            lines |= {line for _, _, line in code.co_lines() if line and line != code.co_firstlineno}
    return lines


@contextmanager
def traced(path: Path) -> Iterator[set[int]]:
    """The lines of the file that run inside; in this thread only."""
    name, seen = str(path), set[int]()

    def local(frame: FrameType, event: str, argument: Any) -> Any:
        if event == "line":
            seen.add(frame.f_lineno)
        return local

    def tracer(frame: FrameType, event: str, argument: Any) -> Any:
        return local if frame.f_code.co_filename == name else None

    before = sys.gettrace()
    sys.settrace(tracer)
    try:
        yield seen
    finally:
        sys.settrace(before)
