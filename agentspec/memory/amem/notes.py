"""A note of A-Mem, and what the model may say about one."""

from __future__ import annotations

from dataclasses import dataclass, field

from agentspec.state import Record

MOST_WORDS = 8
"""Keywords, and tags, of a note."""


@dataclass(frozen=True)
class Note(Record):
    """One note: steps as pairs of state and line (see `telling.course`), and what the model says of them.

    `written` and `used` (when it was written or recalled last) are in steps of the run.
    """

    id: int
    steps: list[list[str]]
    written: int
    episode: int = 0
    keywords: list[str] = field(default_factory=list)
    context: str = ""
    tags: list[str] = field(default_factory=list)
    links: list[int] = field(default_factory=list)
    used: int = 0
    recalled: int = 0
    history: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """The id that the model sees."""
        return f"n{self.id}"

    def text(self) -> str:
        """What is embedded: content, context, keywords and tags."""
        content = [part for pair in self.steps for part in pair if part]
        return " ".join([*content, self.context, *self.keywords, *self.tags])

    def described(self, content: str) -> str:
        """As the model reads it, with `content` for its steps."""
        about = [f"({', '.join(self.tags)})"] if self.tags else []
        parts = [f"[{self.name}]", *([self.context] if self.context else []), *about]
        return f"{' '.join(parts)}\n{content}"


@dataclass(frozen=True)
class Analysis:
    """Answer to the first question."""

    keywords: tuple[str, ...]
    context: str
    tags: tuple[str, ...] = ()


@dataclass(frozen=True)
class Neighbour:
    """What an old note should become; what is left out stays."""

    id: str
    context: str = ""
    tags: tuple[str, ...] = ()


@dataclass(frozen=True)
class Evolution:
    """Answer to the second question."""

    evolve: bool
    links: tuple[str, ...] = ()
    tags: tuple[str, ...] = ()
    neighbours: tuple[Neighbour, ...] = ()


def words(given: tuple[str, ...]) -> list[str]:
    """Words on one line each, without repeats, at most `MOST_WORDS`."""
    return list(dict.fromkeys(w for word in given if (w := " ".join(word.split())[:64])))[:MOST_WORDS]


def id_of(name: str) -> int:
    """The number in `n3`, `[n3]` or `3`; -1 if there is none."""
    digits = name.strip().strip("[]").removeprefix("n")
    return int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 10 else -1
