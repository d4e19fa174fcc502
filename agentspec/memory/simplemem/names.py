"""Places and entities: told in a text by their spelling, and the notes that name them."""

from __future__ import annotations

import re
from collections.abc import Iterable

from agentspec.memory.parts.entries import Entry

WORD = re.compile(r"[^\W_]+(?:\.\d+)?")
_NAME = re.compile(r"\b(?:[A-Z][\w-]*|\w*\d[\w.]*)\b")
_VAGUE = re.compile(
    r"\b(he|she|it|they|him|her|them|this|these|those|now|today|yesterday|tomorrow|later|soon|recently|ago)\b", re.I
)


def names_in(text: str) -> set[str]:
    """Words with a capital or a digit."""
    return set(_NAME.findall(text))


def is_vague(text: str) -> bool:
    """Whether a text has pronouns or relative times."""
    return bool(_VAGUE.search(text))


class Named:
    """Place or entity -> the notes that name it, in the order in which they were added."""

    def __init__(self) -> None:
        self._notes: dict[str, dict[int, None]] = {}

    def add(self, *entries: Entry) -> None:
        """Note what these name."""
        for entry in entries:
            for name in entry.data["names"]:
                self._notes.setdefault(name, {})[entry.id] = None

    def rebuild(self, entries: Iterable[Entry]) -> None:
        """Forget the names of notes that are gone."""
        self._notes = {}
        self.add(*entries)

    def by(self, query: str) -> list[int]:
        """Notes with a place or entity that the query names."""
        words = [w.casefold() for w in WORD.findall(query)]
        phrases = dict.fromkeys(" ".join(words[i : i + n]) for n in (3, 2, 1) for i in range(len(words) - n + 1))
        return list(dict.fromkeys(id for p in phrases for id in self._notes.get(p, ())))
