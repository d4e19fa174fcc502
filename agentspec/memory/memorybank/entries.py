"""Entries of MemoryBank: how they fade, what a model concludes of a day, and what is said of one without a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from agentspec.state import Record


def retention(elapsed: float, strength: float, unit: float = 1.0) -> float:
    """Ebbinghaus' R = e^(-t / (unit * S)): how likely an entry is remembered `elapsed` after its last recall.

    >>> [round(retention(t, s), 4) for t, s in ((0, 1), (1, 1), (5, 5), (10, 2))]
    [1.0, 0.3679, 0.3679, 0.0067]
    """
    return math.exp(-elapsed / (unit * strength))


@dataclass(frozen=True)
class Entry(Record):
    """One memory: what it says, from when, how strong it is, and the step of the run at which it was last recalled."""

    kind: str
    text: str
    episode: int
    step: int
    since: int
    strength: int = 1


@dataclass(frozen=True)
class Conclusions:
    """The answer of a model that draws insights."""

    insights: list[str]
    avoid: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)


def by_rule(day: Sequence[Entry], ending: str = "") -> str:
    """A summary without a model: how many steps of each action, how many failed, what paid, and the newest result."""
    if not day:
        return ending
    actions: dict[str, int] = {}
    for entry in day:
        name = entry.text.split("(", 1)[0].split(" ", 1)[0]
        actions[name] = actions.get(name, 0) + 1
    failed = sum(is_failure(entry.text) for entry in day)
    done = ", ".join(f"{name} x{n}" for name, n in actions.items())
    last = day[-1].text.split(" | in: ", 1)[0]
    text = f"Steps {day[0].step + 1}-{day[-1].step + 1}: {done}; {failed} failed; last: {last}."
    return f"{text} {ending}".strip()


def avoid_by_rule(day: Sequence[Entry]) -> list[str]:
    """The newest distinct failures of the day, as actions with what the environment said."""
    failures = [entry.text.split(" | in: ", 1)[0] for entry in day if is_failure(entry.text)]
    return list(dict.fromkeys(reversed(failures)))[:2]


def is_failure(text: str) -> bool:
    """Whether the text of a step says that its action failed."""
    return " failed: " in text.split(" -> ", 1)[0]
