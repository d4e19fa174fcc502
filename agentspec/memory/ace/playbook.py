"""A playbook: short bullets with an id and two counters, changed only by named deltas. The data structure of ACE.

Nothing here asks a model. A delta names what changes; every other bullet stays as it is, byte for byte.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from agentspec.state import Json, Record, joined
from agentspec.tokens import CountTokens

SECTIONS = {"STRATEGIES": "str", "MISTAKES": "mis", "FACTS": "fac", "OTHERS": "oth"}
"""Section -> prefix of its bullets' ids, in the order they are shown."""

OTHERS = "OTHERS"
TYPES = ("ADD", "UPDATE", "MERGE", "REMOVE")
_CITED = re.compile(rf"\b(?:{'|'.join(SECTIONS.values())})-\d{{5,}}\b")


@dataclass(frozen=True)
class Bullet(Record):
    """One entry: its number (never given twice), section, text, and how often it was found helpful and harmful."""

    number: int
    section: str
    text: str
    helpful: int = 0
    harmful: int = 0

    @property
    def id(self) -> str:
        """The name it is cited by, `str-00012`."""
        return f"{SECTIONS[self.section]}-{self.number:05d}"

    @property
    def balance(self) -> int:
        """Helpful minus harmful."""
        return self.helpful - self.harmful

    def line(self) -> str:
        """As it is shown to every role."""
        return f"[{self.id}] helpful={self.helpful} harmful={self.harmful} :: {self.text}"


@dataclass(frozen=True)
class Operation:
    """One delta: `ADD` with section and text, `UPDATE` with id and text, `MERGE` with ids and text, `REMOVE` an id."""

    type: str
    section: str = ""
    id: str = ""
    ids: tuple[str, ...] = ()
    content: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "type", self.type.strip().upper())
        if self.type not in TYPES:
            raise ValueError(f"'type' must be one of {', '.join(TYPES)}, not {self.type[:20]!r}")


class Playbook:
    """Bullets in the order of their numbers."""

    def __init__(self, bullets: Iterable[Bullet] = ()) -> None:
        self._bullets = {b.id: b for b in bullets}

    def __len__(self) -> int:
        return len(self._bullets)

    def __iter__(self) -> Iterator[Bullet]:
        return iter(self._bullets.values())

    def __contains__(self, id: object) -> bool:
        return id in self._bullets

    def __getitem__(self, id: str) -> Bullet:
        return self._bullets[id]

    def ordered(self) -> list[Bullet]:
        """By section, then by number: the order shown."""
        places = list(SECTIONS)
        return sorted(self, key=lambda b: (places.index(b.section), b.number))

    def cited(self, text: str) -> list[str]:
        """Ids of bullets that a text names, in order, each once."""
        return [id for id in dict.fromkeys(_CITED.findall(text)) if id in self._bullets]

    def tag(self, id: str, tag: str) -> bool:
        """Count a verdict (`helpful`, `harmful` or `neutral`) on a bullet; whether there is such a bullet."""
        bullet = self._bullets.get(id_of(id))
        if bullet is not None and tag in ("helpful", "harmful"):
            self._bullets[bullet.id] = replace(bullet, **{tag: getattr(bullet, tag) + 1})
        return bullet is not None

    def apply(self, operation: Operation, new_number: Callable[[], int]) -> Bullet | None:
        """Carry out one delta.

        Args:
            operation: see `Operation`; its text must be ready to be kept.
            new_number: number of a bullet that is added; asked only then.

        Returns:
            the bullet that was added or changed; `None` if there is none (a removal, or a delta that names nothing
            there is).
        """
        text = operation.content
        if operation.type == "ADD":
            return self._add(operation.section, text, new_number) if text else None
        if operation.type == "MERGE":
            return self.merge(operation.ids, text) if text else None
        id = id_of(operation.id)
        if id not in self._bullets:
            return None
        if operation.type == "REMOVE":
            del self._bullets[id]
            return None
        if not text:
            return None
        self._bullets[id] = replace(self._bullets[id], text=text)
        return self._bullets[id]

    def merge(self, ids: Sequence[str], text: str) -> Bullet | None:
        """One bullet of several: the oldest one's place and id, `text`, and the sums of the counters."""
        named = dict.fromkeys(map(id_of, ids))
        found = sorted((self._bullets[id] for id in named if id in self._bullets), key=lambda b: b.number)
        if len(found) < 2:
            return None
        kept = replace(
            found[0], text=text, helpful=sum(b.helpful for b in found), harmful=sum(b.harmful for b in found)
        )
        for bullet in found[1:]:
            del self._bullets[bullet.id]
        self._bullets[kept.id] = kept
        return kept

    def prune(self, tokens: int, most: int, count_tokens: CountTokens) -> list[Bullet]:
        """Drop bullets until the rest has at most `tokens` tokens and is at most `most`; what was dropped.

        The lowest balance goes first (those found harmful at least as often as helpful before all others), of equals
        the oldest.
        """
        costs = {b.id: count_tokens(b.line()) + 1 for b in self}
        used, dropped = sum(costs.values()), list[Bullet]()
        for bullet in sorted(self, key=lambda b: (b.balance, b.number)):
            if used <= tokens and len(self) <= most:
                break
            del self._bullets[bullet.id]
            used -= costs[bullet.id]
            dropped.append(bullet)
        return dropped

    def state(self) -> Json:
        """State as JSON."""
        return joined(b.json for b in self)

    @classmethod
    def load(cls, state: Iterable[Sequence[Any]]) -> Playbook:
        """What `state` gave."""
        return cls(Bullet(*row) for row in state)

    def _add(self, section: str, text: str, new_number: Callable[[], int]) -> Bullet | None:
        if any(b.text.casefold() == text.casefold() for b in self):
            return None  # word for word what is there already
        bullet = Bullet(new_number(), section_of(section), text)
        self._bullets[bullet.id] = bullet
        return bullet


def id_of(name: str) -> str:
    """The id in a name: models copy the brackets that it is shown in.

    >>> id_of("[str-00012]"), id_of("str-00012"), id_of("none")
    ('str-00012', 'str-00012', 'none')
    """
    found = _CITED.search(name)
    return found[0] if found else name


def section_of(name: str) -> str:
    """The section that a model means by a name, `OTHERS` if there is none.

    >>> section_of("strategies "), section_of("Weather")
    ('STRATEGIES', 'OTHERS')
    """
    wanted = name.strip().upper()
    return wanted if wanted in SECTIONS else OTHERS
