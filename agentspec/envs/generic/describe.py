"""Observations of any Gymnasium space as compact text, and as plain data.

Short vectors become named numbers. A grid of small integers becomes one symbol per cell with a legend of what each
symbol stands for, so that a 7 x 7 x 3 array takes eight lines. Pictures are announced, not spelled out: they reach a
model as images.
"""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

MAX_NUMBERS = 400
"""Larger arrays that are no grid are summarised by shape and range."""

SMALLEST_PICTURE = 32
"""Pixels; a `uint8` array with fewer rows or columns is a grid of codes, not a picture."""

SYMBOLS = "." + string.ascii_lowercase + string.ascii_uppercase + string.digits


def is_picture(space: spaces.Space[Any]) -> bool:
    """Whether observations of `space` are pictures: `uint8`, (H, W, 3), not tiny."""
    shape = space.shape or ()
    return (
        isinstance(space, spaces.Box)
        and space.dtype == np.uint8
        and len(shape) == 3
        and shape[2] == 3
        and min(shape[:2]) >= SMALLEST_PICTURE
    )


def describe(space: spaces.Space[Any], value: Any, names: Sequence[str] = ()) -> str:
    """`value` of `space` as text; `names` are those of its parts, if known."""
    if isinstance(space, spaces.Dict):
        lines = [_keyed(key, describe(part, value[key])) for key, part in space.spaces.items()]
        return "\n".join(lines)
    if isinstance(space, spaces.Tuple):
        parts = [describe(part, v) for part, v in zip(space.spaces, value, strict=True)]
        return _named(parts, names)
    if is_picture(space):
        height, width = np.shape(value)[:2]
        return f"[a picture of {width} x {height} pixels]"
    return value if isinstance(value, str) else _array(np.asarray(value), names)


def plain(space: spaces.Space[Any], value: Any) -> Any:
    """`value` as JSON data; pictures are left out (`None`)."""
    if isinstance(space, spaces.Dict):
        return {key: plain(part, value[key]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return [plain(part, v) for part, v in zip(space.spaces, value, strict=True)]
    return None if is_picture(space) else as_json(value)


def as_json(value: Any) -> Any:
    """Arrays as lists, numpy scalars as numbers, anything unknown as its `str`."""
    if isinstance(value, Mapping):
        return {str(k): as_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(v) for v in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return value if value is None or isinstance(value, (str, bool, int, float)) else str(value)


def _array(array: np.ndarray, names: Sequence[str]) -> str:
    if array.dtype == object:
        return str(array[()])[:MAX_NUMBERS]
    if array.ndim < 2 and array.size <= MAX_NUMBERS:
        return _named([_number(v) for v in np.atleast_1d(array)], names)
    grid = _grid(array) if array.ndim in (2, 3) else None
    return grid or _numbers(array)


def _keyed(key: str, text: str) -> str:
    return f"{key}:\n{text}" if "\n" in text else f"{key}: {text}"


def _named(parts: Sequence[str], names: Sequence[str]) -> str:
    if len(parts) == len(names):
        return ", ".join(f"{name} {part}" for name, part in zip(names, parts, strict=True))
    return ", ".join(parts)


def _number(value: Any) -> str:
    return str(value) if isinstance(value, (bool, np.bool_, int, np.integer)) else f"{float(value):.4g}"


def _grid(array: np.ndarray) -> str | None:
    """One symbol per cell and a legend; `None` if the array holds no small set of integer cells.

    The first axis runs down the lines. The commonest cell is `.`; the others are letters in the order of their values.
    """
    if array.dtype.kind not in "iub" or array.shape[0] * array.shape[1] > MAX_NUMBERS * 4:
        return None
    cells = [[tuple(np.atleast_1d(cell).tolist()) for cell in row] for row in array]
    flat = [cell for row in cells for cell in row]
    distinct = sorted(set(flat))
    if len(distinct) > min(len(SYMBOLS), max(2, len(flat) // 2)):
        return None
    common = max(distinct, key=flat.count)
    symbol = dict(zip([common, *(c for c in distinct if c != common)], SYMBOLS, strict=False))
    legend = ", ".join(f"{mark} = {' '.join(map(str, cell))}" for cell, mark in symbol.items())
    return "\n".join(["".join(symbol[cell] for cell in row) for row in cells] + [f"({legend})"])


def _numbers(array: np.ndarray) -> str:
    if array.size > MAX_NUMBERS:
        shape = " x ".join(map(str, array.shape))
        return f"[{shape} numbers from {_number(array.min())} to {_number(array.max())}]"
    rows = array.reshape(array.shape[0], -1)
    return "\n".join(" ".join(_number(v) for v in row) for row in rows)
