"""Which lines of a method's functions run: a line tracer for its files, without a dependency."""

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


def function_lines(path: Path, *, public: bool = False) -> set[int]:
    """The lines of a file's functions that can run; `def` lines and docstrings are none.

    Args:
        public: whether public functions beside the classes count: in a helper of the method's own folder; elsewhere
            they serve other modules and have tests of their own.
    """
    module = compile(path.read_text(encoding="utf-8"), str(path), "exec")
    stack = [c for c in _codes(module) if public or not c.co_flags & NEW_LOCALS or c.co_name.startswith(("_", "<"))]
    lines: set[int] = set()
    while stack:
        code = stack.pop()
        stack += _codes(code)
        if code.co_flags & NEW_LOCALS:
            lines |= {line for _, _, line in code.co_lines() if line and line != code.co_firstlineno}
    return lines


def files_of(path: Path) -> list[Path]:
    """The files of the method whose class is in `path`: all of its folder where it has one, else that one."""
    return sorted(path.parent.glob("*.py")) if path.name == "__init__.py" else [path]


@contextmanager
def traced(*paths: Path) -> Iterator[dict[Path, set[int]]]:
    """The lines of the files that run inside; in this thread only."""
    seen: dict[Path, set[int]] = {path: set() for path in paths}
    by_name = {str(path): lines for path, lines in seen.items()}

    def tracer(frame: FrameType, event: str, argument: Any) -> Any:
        lines = by_name.get(frame.f_code.co_filename)
        if lines is None:
            return None

        def local(frame: FrameType, event: str, argument: Any) -> Any:
            if event == "line":
                lines.add(frame.f_lineno)
            return local

        return local

    before = sys.gettrace()
    sys.settrace(tracer)
    try:
        yield seen
    finally:
        sys.settrace(before)
