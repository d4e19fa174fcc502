"""A temporal knowledge graph: entities, and facts between them with four times each (Rasmussen et al., 2025).

Two times are the world's: since when a fact has been so (`valid`), and since when no longer (`invalid`). Two are the
memory's: when it was written (`Entry.time`), and when it was found to be over (`expired`). Facts are never deleted by
what contradicts them, so that the graph can be asked how things stood at any step. All are counted in steps of the run.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

from agentspec.memory.parts.entries import Entries, Entry
from agentspec.protocols import Embedder
from agentspec.retrieval import Graph, mmr, reciprocal_rank_fusion
from agentspec.services import Time

_WORD = re.compile(r"[^\W_]+(?:\.\d+)?")
_ARTICLES = ("the", "a", "an")
_DIGITS = re.compile(r"\d+")
_MOST_WORDS = 4


class TemporalGraph:
    """Entities and facts.

    Args:
        embedder: text -> unit vector.
        capacity: most facts; beyond, the one written longest ago goes, and entities without facts with it.
    """

    def __init__(self, embedder: Embedder, capacity: int) -> None:
        self.facts = Entries(embedder, capacity, words=True)
        self.names: dict[int, str] = {}
        self._ids: dict[str, int] = {}  # normal name -> entity
        self._of: dict[int, dict[int, None]] = {}  # entity -> its facts
        self.graph: Graph[int] = Graph()

    # -- entities --------------------------------------------------------------------------------------------------

    def entity(self, name: str) -> int | None:
        """The entity of this name (case and punctuation apart), if it is known."""
        return self._ids.get(normal(name))

    def add_entity(self, id: int, name: str) -> None:
        """Add an entity."""
        self.names[id] = name
        self._ids[normal(name)] = id
        self._of[id] = {}
        self.graph.add(id)

    def call(self, id: int, name: str) -> None:
        """Another name of a known entity."""
        self._ids.setdefault(normal(name), id)

    def alike(self, name: str, k: int, least: float) -> list[int]:
        """Known entities that `name` may mean: near in meaning or sharing words, and with the same numbers in it.

        `restaurant 1` and `restaurant 2` are alike and never the same.
        """
        others = [(id, known) for id, known in self.names.items() if _DIGITS.findall(known) == _DIGITS.findall(name)]
        if not others:
            return []
        vectors = self.facts.embed([name, *(known for _, known in others)])
        words = set(normal(name).split())
        scored = []
        for (id, known), vector in zip(others, vectors[1:], strict=True):
            shared = words & set(normal(known).split())
            score = max(float(vectors[0] @ vector), len(shared) / max(1, min(len(words), len(normal(known).split()))))
            if score >= least:
                scored.append((score, id))
        return [id for _, id in sorted(scored, key=lambda pair: -pair[0])[:k]]

    def named_in(self, text: str) -> list[int]:
        """Entities whose name stands in a text, in the order of their first mention."""
        words = normal(text).split()
        found: dict[int, None] = {}
        for i in range(len(words)):
            for n in range(_MOST_WORDS, 0, -1):
                id = self._ids.get(" ".join(words[i : i + n])) if i + n <= len(words) else None
                if id is not None:
                    found[id] = None
                    break
        return list(found)

    # -- facts -----------------------------------------------------------------------------------------------------

    def add_fact(self, id: int, text: str, time: Time, triple: tuple[int, str, int], valid: int) -> Entry:
        """Add a fact between two known entities; it is so since step `valid` of the run."""
        subject, relation, target = triple
        data = {"triple": [subject, relation, target], "valid": valid, "invalid": None, "expired": None}
        entry = Entry(id, text, time, {**data, "mentions": [time.total]})
        evicted = self.facts.evicted
        self.facts.put(entry)
        self._link(entry)
        if self.facts.evicted != evicted:
            self._rebuild()
        return entry

    def remove_fact(self, id: int) -> None:
        """Forget a fact that says what another says."""
        self.facts.remove(id)
        self._rebuild()

    def mention(self, id: int, time: Time, most: int = 16) -> None:
        """A fact was told again."""
        entry = self.facts[id]
        mentions = [*entry.data["mentions"], time.total][-most:]
        self.facts.put(replace(entry, time=time, data={**entry.data, "mentions": mentions}))

    def contradict(self, new: int, old: int, now: int) -> None:
        """Two facts cannot both be so: the one that came first in the world ends where the other begins.

        Whichever is told first: what is told late about earlier times is over as soon as it is written. If one had
        ended before the other began, there is no contradiction and both stay as they are.
        """
        first, second = sorted((self.facts[new], self.facts[old]), key=lambda e: (e.data["valid"], e.id == new))
        end, begin = first.data["invalid"], second.data["valid"]
        if end is not None and end <= begin:
            return
        self.facts.put(replace(first, data={**first.data, "invalid": begin, "expired": now}))

    def of(self, entities: Iterable[int]) -> Iterator[Entry]:
        """Facts of some entities, each once."""
        ids = dict.fromkeys(id for entity in entities for id in self._of.get(entity, ()))
        return (self.facts[id] for id in ids)

    def as_of(self, step: int) -> list[Entry]:
        """The facts that were so at a step of the run, as far as is known today."""
        return [e for e in self.facts if holds(e, step)]

    # -- search ----------------------------------------------------------------------------------------------------

    def search(
        self, query: str, k: int, *, least: float, hops: int, past: bool, rerank: str = "rrf"
    ) -> list[tuple[Entry, float]]:
        """The best facts: by meaning, by words, and along the graph from what the query names.

        Args:
            least: smallest cosine similarity that counts.
            hops: how far along the graph.
            past: whether facts that are over count.
            rerank: `rrf` (reciprocal ranks, 1 / rank), `mmr` (the same, unlike each other) or `mentions`.
        """
        where = None if past else _open
        near = [(e.id, s) for e, s in self.facts.near(query, 2 * k, least=least, where=where)]
        words = [(e.id, s) for e, s in self.facts.by_words(query, 2 * k, where=where)]
        start = self.named_in(query) or list(
            dict.fromkeys(e for id, _ in [*near[:3], *words[:3]] for e in self._ends(id))
        )
        around = self._around(start, hops, 2 * k, where)
        fused = reciprocal_rank_fusion([near, words, around], constant=0.0)
        if rerank == "mentions":
            fused = sorted(fused, key=lambda pair: -len(self.facts[pair[0]].data["mentions"]))
        elif rerank == "mmr":
            fused = mmr(fused, self.facts.cosine, k)
        fused.sort(key=lambda pair: not _open(self.facts[pair[0]]))  # what is over comes last
        return [(self.facts[id], score) for id, score in fused[:k]]

    def _around(self, start: list[int], hops: int, most: int, where: Any) -> list[tuple[int, float]]:
        """Facts near some entities: those of the nearest first, of equals the newest."""
        if not start or hops < 1:
            return []
        distance = self.graph.within(start, hops - 1)
        facts: dict[int, int] = {}
        for entity, far in distance.items():
            newest = sorted(self._of[entity], key=lambda id: -self.facts[id].time.total)
            for id in newest[:most]:
                if where is None or where(self.facts[id]):
                    facts.setdefault(id, far)
            if len(facts) >= most:
                break
        return [(id, -float(far)) for id, far in list(facts.items())[:most]]

    def _ends(self, id: int) -> tuple[int, int]:
        subject, _, target = self.facts[id].data["triple"]
        return subject, target

    def _link(self, entry: Entry) -> None:
        subject, target = self._ends(entry.id)
        for entity in (subject, target):
            self._of[entity][entry.id] = None
        self.graph.connect(subject, target)

    def _rebuild(self) -> None:
        """Links anew, after facts have gone; entities without facts go, too."""
        kept = dict.fromkeys(entity for e in self.facts for entity in self._ends(e.id))
        self.names = {id: name for id, name in self.names.items() if id in kept}
        self._ids = {name: id for name, id in self._ids.items() if id in kept}
        self._of = {id: {} for id in self.names}
        self.graph = Graph()
        for id in self.names:
            self.graph.add(id)
        for entry in self.facts:
            self._link(entry)

    def state(self) -> list[Any]:
        """JSON-like state."""
        return [[[id, name] for id, name in self.names.items()], list(self._ids.items()), self.facts.state()]

    def load(self, state: list[Any]) -> None:
        """Return to `state`."""
        names, ids, facts = state
        self.names, self._ids = {id: name for id, name in names}, {name: id for name, id in ids}
        self.facts.load(facts)
        self._of, self.graph = {id: {} for id in self.names}, Graph()
        for id in self.names:
            self.graph.add(id)
        for entry in self.facts:
            self._link(entry)


def normal(name: str) -> str:
    """A name as it is looked up: its words in small letters, without articles.

    >>> normal("The restaurant 5 (left)")
    'restaurant 5 left'
    """
    words = _WORD.findall(name.casefold())
    return " ".join([word for word in words if word not in _ARTICLES] or words)


def holds(fact: Entry, step: int) -> bool:
    """Whether a fact is so at a step of the run."""
    invalid = fact.data["invalid"]
    return fact.data["valid"] <= step and (invalid is None or step < invalid)


def _open(fact: Entry) -> bool:
    return fact.data["invalid"] is None
