"""What lessons are worth: a table of first and second trials, with and without a lesson between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

from eval.statistics import mean_interval, paired
from eval.tables import show, table


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Per reflector the mean return of both trials and what the lessons changed; then each less those before it.

    A first trial that was good enough has no second one: it counts with its own return, and a gain of 0. Tasks with a
    trial that failed to run are left out.
    """
    body, gains = [], {}
    for label in dict.fromkeys(row["reflector"] for row in rows):
        members = [r for r in rows if r["reflector"] == label]
        played = [r for r in members if r["first_return"] is not None and r["second_return"] is not None]
        gains[label] = {r["task"]: r["second_return"] - r["first_return"] for r in played}
        returns = [mean_interval([r[key] for r in played]) for key in ("first_return", "second_return")]
        lessons = sum(bool(r["lesson"]) for r in played)
        numbers = [show(e, 2) for e in (*returns, mean_interval(list(gains[label].values())))]
        body.append([label, str(len(played)), str(lessons), *numbers])
    pairs = [(a, b) for b, a in combinations(gains, 2)]
    lines = [
        "# What lessons are worth",
        "",
        "Return of the first and of the second trial on held-out tasks, mean over tasks, 95% t interval.",
        "",
        *table(["reflector", "tasks", "lessons", "first trial", "second trial", "gain"], body),
        "",
        *(f"Paired difference in gain, {a} less {b}: {show(paired(gains[a], gains[b]), 2)}." for a, b in pairs),
    ]
    return "\n".join(lines) + "\n"
