"""A temporal knowledge graph: entities, and facts between them with four times each (Rasmussen et al., 2025).

Two times are the world's: since when a fact has been so (`valid`), and since when no longer (`invalid`). Two are the
memory's: when it was written (`Entry.time`), and when it was found to be over (`expired`). Facts are never deleted by
what contradicts them, so that the graph can be asked how things stood at any step. All are counted in steps of the run.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from agentspec.memory.parts.entries import Entries, Entry
from agentspec.protocols import Embedder
from agentspec.retrieval import Graph, mmr, reciprocal_rank_fusion
from agentspec.services import Time
from agentspec.state import Json, joined

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
        self.graph: Graph[int] = Graph()
        self._ids: dict[str, int] = {}  # normal name -> entity
        self._of: dict[int, dict[int, None]] = {}  # entity -> its facts
        self._called: dict[int, list[str]] = {}  # entity -> its normal names
        self._numbered: dict[tuple[str, ...], dict[int, None]] = {}  # numbers in a name -> entities
        self._written: dict[int, Json] = {}  # entities as a snapshot has them, until they change

    # -- entities --------------------------------------------------------------------------------------------------

    def entity(self, name: str) -> int | None:
        """The entity of this name (case and punctuation apart), if it is known."""
        return self._ids.get(normal(name))

    def add_entity(self, id: int, name: str) -> None:
        """Add an entity."""
        self.names[id] = name
        self._numbered.setdefault(_numbers(name), {})[id] = None
        self._of[id], self._called[id] = {}, []
        self.graph.add(id)
        self.call(id, name)

    def call(self, id: int, name: str) -> None:
        """Another name of a known entity."""
        known_as = normal(name)
        if known_as not in self._ids:
            self._ids[known_as] = id
            self._called[id].append(known_as)
            self._written.pop(id, None)

    def alike(self, name: str, k: int, least: float) -> list[int]:
        """Known entities that `name` may mean: near in meaning or sharing words, and with the same numbers in it.

        `restaurant 1` and `restaurant 2` are alike and never the same.
        """
        others = [(id, self.names[id]) for id in self._numbered.get(_numbers(name), ())]
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
        forgotten = self.facts.put(entry)
        self._link(entry)
        for old in forgotten:
            self._unlink(old)
        return entry

    def remove_fact(self, id: int) -> None:
        """Forget a fact that says what another says."""
        fact = self.facts.remove(id)
        if fact is not None:
            self._unlink(fact)

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

        What is over is ranked as everything else is: how things stood may be what is asked for.

        Args:
            least: smallest cosine similarity that counts.
            hops: how far along the graph.
            past: whether facts that are over count.
            rerank: `rrf` (reciprocal ranks, 1 / rank), `mmr` (the same, unlike each other) or `mentions`.
        """
        where = None if past else _open
        near = [(e.id, s) for e, s in self.facts.near(query, 2 * k, least=least, where=where)]
        words = [(e.id, s) for e, s in self.facts.by_words(query, 2 * k, where=where)]
        best = dict.fromkeys(id for id, _ in [*near[:3], *words[:3]])
        start = self.named_in(query) or list(dict.fromkeys(e for id in best for e in self._ends(self.facts[id])))
        around = self._around(start, hops, 2 * k, where)
        fused = reciprocal_rank_fusion([near, words, around], constant=0.0)
        if rerank == "mentions":
            fused = sorted(fused, key=lambda pair: -len(self.facts[pair[0]].data["mentions"]))
        elif rerank == "mmr":
            fused = mmr(fused, self.facts.cosine, k)
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

    def _ends(self, fact: Entry) -> tuple[int, int]:
        subject, _, target = fact.data["triple"]
        return subject, target

    def _link(self, fact: Entry) -> None:
        subject, target = self._ends(fact)
        for entity in (subject, target):
            self._of[entity][fact.id] = None
            self._written.pop(entity, None)
        self.graph.connect(subject, target)

    def _unlink(self, fact: Entry) -> None:
        """Forget the links of a fact that has gone; entities without facts go, too."""
        subject, target = self._ends(fact)
        for entity in dict.fromkeys((subject, target)):
            self._of[entity].pop(fact.id, None)
            self._written.pop(entity, None)
        if not self._of[subject].keys() & self._of[target].keys():
            self.graph.disconnect(subject, target)
        for entity in dict.fromkeys((subject, target)):
            if not self._of[entity]:
                self._forget(entity)

    def _forget(self, entity: int) -> None:
        numbers = _numbers(self.names.pop(entity))
        del self._numbered[numbers][entity], self._of[entity]
        if not self._numbered[numbers]:
            del self._numbered[numbers]
        for name in self._called.pop(entity):
            del self._ids[name]
        self.graph.remove(entity)

    def state(self) -> Json:
        """State as JSON."""
        for id, name in self.names.items():
            if id not in self._written:
                self._written[id] = Json.of([id, name, self._called[id], list(self.graph.neighbours(id))])
        return joined([joined(self._written[id] for id in self.names), self.facts.state()])

    def load(self, state: list[Any]) -> None:
        """Return to `state`."""
        entities, facts = state
        self.names, self._ids, self._of, self._called, self._numbered, self._written = {}, {}, {}, {}, {}, {}
        self.graph = Graph()
        self.facts.load(facts)
        for id, name, called, _ in entities:
            self.names[id], self._of[id], self._called[id] = name, {}, called
            self._numbered.setdefault(_numbers(name), {})[id] = None
            self._ids |= dict.fromkeys(called, id)
        self.graph.load([[id, [[other, 1.0] for other in near]] for id, _, _, near in entities])
        for fact in self.facts:
            for entity in self._ends(fact):
                self._of[entity][fact.id] = None


def normal(name: str) -> str:
    """A name as it is looked up: its words in small letters, without articles.

    >>> normal("The restaurant 5 (left)")
    'restaurant 5 left'
    """
    words = _WORD.findall(name.casefold())
    return " ".join([word for word in words if word not in _ARTICLES] or words)


def _numbers(name: str) -> tuple[str, ...]:
    return tuple(_DIGITS.findall(name))


def holds(fact: Entry, step: int) -> bool:
    """Whether a fact is so at a step of the run."""
    invalid = fact.data["invalid"]
    return fact.data["valid"] <= step and (invalid is None or step < invalid)


def _open(fact: Entry) -> bool:
    return fact.data["invalid"] is None


def fields_of(state: Mapping[str, Any], subject: str, deep: int = 3) -> Iterator[tuple[str, str, str]]:
    """The fields of a structured state: whose, which, and their value, where that is short."""
    for key, value in state.items():
        if isinstance(value, Mapping) and deep:
            yield from fields_of(value, str(key), deep - 1)
        elif isinstance(value, str | int | float | bool) and len(str(value)) <= 60:
            yield subject, str(key), str(value)
