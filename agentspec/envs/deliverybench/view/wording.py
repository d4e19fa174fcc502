"""How texts say things: points, clock times, durations, lists, and ways (with "here" for what is in reach)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from agentspec.envs.deliverybench.view.calls import within_reach

View = Mapping[str, Any]
Card = Mapping[str, Any]

HERE = "here"
MODE_WORDS = {"walk": "on foot", "drag_scooter": "dragging the scooter", "car": "in the rented car"}
SHORT_MODE = {"walk": "on foot", "drag_scooter": "dragging scooter", "e-scooter": "scooter"}


def listing(title: str, lines: Sequence[str], empty: str) -> str:
    """A titled list, one entry a line, or what to say when there is none."""
    return f"{title}: {empty}." if not lines else f"{title}:\n" + "\n".join(f"- {line}" for line in lines)


def at(xy: Sequence[float]) -> str:
    """A point in metres: `(120.5m, -48.0m)`."""
    # Adding zero turns -0.0 into 0.0.
    return f"({round(xy[0], 1) + 0.0:.1f}m, {round(xy[1], 1) + 0.0:.1f}m)"


def away(view: View, xy: Sequence[float], metres: float) -> str:
    """The way to a place: `here` when it is in reach, else its length.

    Ways run along the street and back to the door, so their length is 8 to 16 m even where one can reach out and act.
    """
    return HERE if within_reach(view, xy) else f"{metres:.0f}m"


def clock(seconds: float) -> str:
    """`00:06:28`."""
    whole = int(seconds)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def minutes(seconds: float) -> int:
    """Whole minutes, rounded up."""
    return math.ceil(seconds / 60.0 - 1e-9)


def duration(seconds: float) -> str:
    """`40 s`, `6 min`, `1 h 20 min`."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    hours, rest = divmod(round(whole / 60.0), 60)
    return f"{hours} h {rest} min" if hours and rest else (f"{hours} h" if hours else f"{rest} min")


def exactly(seconds: float) -> str:
    """`40 s`, `6 min 5 s`, `1 h 20 min`, to the second: what a courier plans by. Zero parts are left out."""
    whole = max(0, round(seconds))
    parts = ((whole // 3600, "h"), (whole // 60 % 60, "min"), (whole % 60, "s"))
    return " ".join(f"{n} {unit}" for n, unit in parts if n) or "0 s"


def deadline(time_left_s: float, told: Callable[[float], str] = exactly) -> str:
    """`3 min 5 s left`, `40 s late`; `told` says how exactly."""
    return f"{told(abs(time_left_s))} {'late' if time_left_s < 0.0 else 'left'}"


def in_minutes(seconds: float) -> str:
    """`4 min`: whole minutes, rounded up, for the short texts of the menu."""
    return f"{minutes(seconds)} min"


def cut(text: str, length: int) -> str:
    """A text of at most so many characters."""
    return text if len(text) <= length else text[: length - 3] + "..."


def joined(words: Sequence[str], last: str = "or") -> str:
    """`a`, `a or b`, `a, b or c`."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}" if words else ""
