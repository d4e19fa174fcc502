"""What the reflector answers, and what ACE keeps between two adaptations."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Verdict:
    """What the reflector says of one bullet; a tag that is none of the three says nothing."""

    id: str
    tag: str


@dataclass(frozen=True)
class Review:
    """What the reflector answers."""

    insight: str
    error: str = ""
    cause: str = ""
    correct: str = ""
    bullets: tuple[Verdict, ...] = ()

    def text(self) -> str:
        """As the curator reads it."""
        parts = (("Wrong", self.error), ("Why", self.cause), ("Right", self.correct), ("Insight", self.insight))
        return " ".join(f"{name}: {' '.join(text.split())}" for name, text in parts if text.strip())


@dataclass
class Counts:
    """What happened to the playbook so far."""

    reviews: int = 0
    added: int = 0
    changed: int = 0
    merged: int = 0
    dropped: int = 0


@dataclass
class Waiting:
    """Steps to be reflected on with the instruction they followed, what they cited, how many steps since the last
    reflection, reviews to be curated."""

    steps: list[str] = field(default_factory=list)
    cited: list[str] = field(default_factory=list)
    since: int = 0
    reviews: list[str] = field(default_factory=list)
    due: bool = False
    task: str = ""
