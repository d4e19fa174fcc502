"""What captions and figures of a report are called, and what they say of their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from eval.naming import slug

Row = Mapping[str, Any]
LEVEL = 0.95


def unit_of(rows: Sequence[Row]) -> str:
    """What a caption says of the numbers: tasks, repeats, runs."""
    tasks = len({row["task"] for row in rows})
    repeats = len({row["rollout"] for row in rows})
    runs = {p: len({r.get("run", "") for r in rows if r["policy"] == p}) for p in {r["policy"] for r in rows}}
    several = max(runs.values())
    over = f" of up to {several} training runs" if several > 1 else ""
    unit = "over training runs where there are three and more, else over tasks" if several > 1 else "over tasks"
    return f"n = {tasks} tasks x {repeats} repeats{over}; {LEVEL:.0%} t intervals {unit}"


def name_of(text: str) -> str:
    """A label as part of a figure's name."""
    return slug(text).replace("_", "-")


def acts(row: Row) -> bool:
    """Whether a model acted, not a scripted policy."""
    return bool(row.get("agent")) and row["agent"].get("reasoning") not in ("rule_based", "random")
