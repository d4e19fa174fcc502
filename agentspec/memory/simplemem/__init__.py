"""SimpleMem (Liu et al., 2026, arXiv 2601.02553): notes that need no context, merged when alike, found in three ways.

1. *Compression.* A step passes the gate if it holds something new: `weight` times the share of its names and numbers
   that the steps before did not have, plus `1 - weight` times its dissimilarity to them, is at least `gate`, for its
   state or for what was done and came of it; or it earned or cost something. Of every `window` steps that passed, and
   the last `overlap` before them, one call writes notes: each understood by itself, without pronouns, with absolute
   times, and with keywords, place, entities and topic. The newest `context` notes are shown, so that nothing is written
   twice.
2. *Consolidation.* Two notes have affinity `beta * cosine + (1 - beta) * exp(-decay * steps between them)`. Where a new
   note and others reach `affinity`, at least `cluster` of them, one call writes a single note for all; these go into
   the archive, which is not searched.
3. *Retrieval.* Notes are looked up by meaning (25), by words (5) and by the places and entities that the observation
   names (5). Their score is cosine + `words_weight` * BM25 (scaled to 1) + `match_weight` if place or entity match, and
   the best `floor(top * (1 + depth * complexity))` are recalled; complexity is the number of names and numbers in the
   query, 1 from twenty on. With `plan: true` the model first writes one to four queries, and says at most twice what is
   still missing.

AgentSpec's form: a step takes the place of a dialogue turn, so windows are of 8 (upstream: 40 turns, overlap 2), and
the gate looks at steps, not windows. The values of gate, affinity and weights are ours (the published ones could not be
checked, and are for dialogues). Of the paper's tables this is the row *ReAct + SimpleMem* (preset `paper`).

Bounded by `capacity`, notes and archive each. An answer that cannot be read writes nothing; the steps wait, at most
`2 * window`, and are shown to the next call. `vague` among the metrics counts notes with pronouns or relative times.

Cost: one call per `window` of steps that pass, and one per cluster; retrieval 0, or 1 to 3 with `plan`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, system, user
from agentspec.memory.parts.entries import NOTES, Entries, Entry, dated, embedder_of, one_line, recalled
from agentspec.memory.parts.waiting import STEPS, Step, result, shown_lines, task_of, told, unwritten
from agentspec.memory.simplemem.names import Named, is_vague, names_in
from agentspec.memory.simplemem.prompts import CHECK, COMPRESS, MERGE, PLAN, SEEN, Check, Note, Plan, data_of
from agentspec.parameters import at_least, settings
from agentspec.services import Services
from agentspec.state import dump_state, joined, load_state
from agentspec.structured import json_of
from agentspec.tokens import excerpt
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, Task, Transition

PRESETS = {
    "paper": {
        "window": 8,
        "overlap": 1,
        "context": 3,
        "top": 5,
        "max_notes": 12,
        "step_tokens": 320,
        "answer_tokens": 1024,
        "task_tokens": 512,
        "repairs": 1,
    },
    "rl": {
        "window": 8,
        "overlap": 0,
        "context": 3,
        "top": 4,
        "max_notes": 5,
        "step_tokens": 80,
        "answer_tokens": 320,
        "task_tokens": 96,
        "repairs": 0,
    },
}
SEMANTIC, LEXICAL, STRUCTURED = 25, 5, 5
"""Most notes that each way of looking up contributes."""
MOST_QUERIES, MOST_CHECKS = 4, 2


class SimpleMemory:
    """Gate, compression, consolidation, and look-up in three ways.

    Args:
        preset: `paper` or `rl`; see the module's docstring. The parameters that it sets are `None` here.
        window: steps that passed the gate between two calls.
        overlap: steps of the last window shown again.
        context: newest notes shown to the compressing call.
        top: notes recalled for the simplest query.
        max_notes: most notes of a window.
        step_tokens: most tokens of a step in a prompt.
        answer_tokens: most tokens of an answer.
        task_tokens: most tokens of the task's instruction in a prompt.
        repairs: 1 to ask again for an answer that cannot be read, else 0.
        gate: least novelty, 0 to 1 (0: every step passes).
        weight: of new names and numbers in novelty, against dissimilarity.
        consolidate: whether notes are merged.
        affinity: least affinity of notes that are merged.
        beta: weight of the cosine in affinity.
        decay: how fast affinity falls with steps between notes.
        cluster: least number of notes that are merged.
        depth: how much deeper the most complex query looks.
        words_weight: weight of BM25.
        match_weight: weight of a place or entity that matches.
        plan: whether the model plans retrieval.
        capacity: most notes, and most notes in the archive.
        recent: newest steps shown with them, where the prompt does not tell them anyway.
    """

    declaration = Declaration(
        "gated steps compressed into self-contained notes, merged when alike, found by meaning, words and names",
        calls=CallProfile(retrieve=(0, 4), store=(0, 4)),
        rl=CallProfile(retrieve=(0, 2), store=(0, 2)),
        purposes={
            "compress": Purpose(
                "store",
                '{"notes": [{"text": "SUB() takes 1 from the number.", "keywords": ["rule"], "place": "", '
                '"entities": ["world"], "topic": "rules"}, {"text": "SUB() takes 1 from the number always.", '
                '"keywords": [], "place": "", "entities": [], "topic": ""}]}',
            ),
            "merge": Purpose("store", '{"text": "SUB() takes 1 from every number.", "keywords": ["rule"]}'),
            "plan": Purpose("retrieve", '{"queries": ["what SUB() does"]}'),
            "check": Purpose("retrieve", '{"enough": false, "queries": ["what the target is"]}'),
        },
        needs=("embedder",),
        small=(
            {"window": 3, "gate": 0.0, "affinity": 0.5, "cluster": 2, "plan": True},
            {"preset": "rl", "window": 2, "gate": 0.1, "capacity": 2, "recent": 0, "consolidate": False},
        ),
        small_calls=CallProfile(retrieve=(0, 10), store=(0, 4)),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        window: int | None = None,
        overlap: int | None = None,
        context: int | None = None,
        top: int | None = None,
        max_notes: int | None = None,
        step_tokens: int | None = None,
        answer_tokens: int | None = None,
        task_tokens: int | None = None,
        repairs: int | None = None,
        gate: float = 0.15,
        weight: float = 0.5,
        consolidate: bool = True,
        affinity: float = 0.85,
        beta: float = 0.7,
        decay: float = 0.02,
        cluster: int = 3,
        depth: float = 1.0,
        words_weight: float = 0.5,
        match_weight: float = 0.5,
        plan: bool = False,
        capacity: int = 2000,
        recent: int = 3,
    ) -> None:
        counts = {"window": window, "top": top, "max_notes": max_notes, "step_tokens": step_tokens}
        counts |= {"answer_tokens": answer_tokens}
        others = {"overlap": overlap, "context": context, "task_tokens": task_tokens, "repairs": repairs}
        chosen = settings("simplemem", PRESETS, preset, counts | others)
        at_least("simplemem", 1, capacity=capacity, **{name: chosen[name] for name in counts})
        at_least("simplemem", 2, cluster=cluster)
        at_least("simplemem", 0, recent=recent, **{name: chosen[name] for name in others})
        self.services = services
        self.window, self.overlap, self.context, self.top, self.max_notes = (
            chosen[name] for name in ("window", "overlap", "context", "top", "max_notes")
        )
        self.step_tokens, self.answer_tokens, self.task_tokens, self.repairs = (
            chosen[name] for name in ("step_tokens", "answer_tokens", "task_tokens", "repairs")
        )
        self.gate, self.weight = gate, weight
        self.consolidate, self.affinity, self.beta = consolidate, affinity, beta
        self.decay, self.cluster = decay, cluster
        self.depth, self.words_weight, self.match_weight, self.plan = depth, words_weight, match_weight, plan
        self.capacity, self.recent = capacity, recent
        self.entries = Entries(embedder_of(services), capacity, words=True)
        self.archive: list[Entry] = []
        self._named = Named()
        self._window: list[Step] = []  # the overlap, then the steps that are not notes yet
        self._new = 0  # how many of these are new
        self._before: list[list[str]] = []  # what the gate compares with: states, and what was done in them
        self._lines: list[str] = []
        self._left = False
        self._task = ""  # the instruction that the newest step followed
        self._dropped = 0

    def begin_episode(self, task: Task) -> None:
        self._window = self._window[-self._new :] if self._new else []
        self._left = unwritten(self._window)
        self._before, self._lines = [], []

    # -- recall ----------------------------------------------------------------------------------------------------

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """The notes that score best; what an earlier episode left is written first."""
        if self._left and self._new:
            self._left = False
            await self._compress()
        now = self.services.time()
        found = await self._planned(input.text, k) if self.plan else self.search(input.text, k)
        lines = shown_lines(self._lines, max(self.recent, self._new) if self.recent else 0)
        return recalled([(dated(e, now), score) for e, score in found], lines, self.services.llm.module)

    def search(self, query: str, k: int | None = None) -> list[tuple[Entry, float]]:
        """The best notes for a query, with their scores.

        Args:
            k: how many; by default as many as the query's complexity asks for.
        """
        if not len(self.entries):
            return []
        cosine = {entry.id: score for entry, score in self.entries.near(query, SEMANTIC)}
        bm25 = {entry.id: score for entry, score in self.entries.by_words(query, LEXICAL)}
        top = max(bm25.values(), default=1.0)
        named = [id for id in self._named.by(query) if id in self.entries]
        ids = dict.fromkeys([*cosine, *bm25, *named[:STRUCTURED]])
        scores = {
            id: cosine.get(id, 0.0) + self.words_weight * bm25.get(id, 0.0) / top + self.match_weight * (id in named)
            for id in ids
        }
        for id in ids.keys() - cosine.keys():
            scores[id] += self.entries.similarity(query, id)
        best = sorted(ids, key=lambda id: -scores[id])
        return [(self.entries[id], scores[id]) for id in best[: k or self.depth_of(query)]]

    def depth_of(self, query: str) -> int:
        """How many notes a query of this complexity recalls."""
        complexity = min(1.0, len(names_in(query)) / 20)
        return math.floor(self.top * (1 + self.depth * complexity))

    async def _planned(self, state: str, k: int | None) -> list[tuple[Entry, float]]:
        """Queries written by the model, and what it finds still missing; the observation itself is always looked up."""
        found = dict(self._keyed(self.search(state, k)))
        if not found:
            return []
        seen = SEEN.format(state=excerpt(state, self.step_tokens, self.services.llm.count_tokens))
        plan = await self._ask("plan", PLAN, seen, Plan)
        queries: Sequence[str] = plan.queries if plan else ()
        for check in range(MOST_CHECKS + 1):
            for query in queries[:MOST_QUERIES]:
                found |= {id: pair for id, pair in self._keyed(self.search(query, k)) if id not in found}
            if not queries or check == MOST_CHECKS:
                break
            now = self.services.time()
            notes = "\n".join([NOTES, *(dated(entry, now) for entry, _ in found.values())])
            said = await self._ask("check", CHECK, f"{seen}\n\n{notes}", Check)
            queries = said.queries if said and not said.enough else ()
        return list(found.values())

    def _keyed(self, found: Iterable[tuple[Entry, float]]) -> list[tuple[int, tuple[Entry, float]]]:
        return [(entry.id, (entry, score)) for entry, score in found]

    async def _ask(self, purpose: str, static: str, dynamic: str, schema: object) -> Any:
        parse = json_of(schema, repairs=self.repairs, whole=False)
        answer = await self.services.ask(purpose, (system(static), user(dynamic)), self.answer_tokens, parse)
        return answer.value

    # -- writing ---------------------------------------------------------------------------------------------------

    async def store(self, transition: Transition) -> None:
        step = Step.of(transition, self.services, self.step_tokens)
        self._lines = [*self._lines, step.line][-max(1, self.recent, self.window) :]
        self._task = transition.input.instruction
        parts = [transition.input.text, step.line.partition(". ")[2]]
        novelty = max(self.novelty(part, [b[i] for b in self._before]) for i, part in enumerate(parts))
        novel = novelty >= self.gate or bool(transition.reward)
        self._dropped += not novel
        if novel:
            self._before = [*self._before, parts][-self.window :]
            self._window = [*self._window, step][-2 * self.window - self.overlap :]
            self._new = min(self._new + 1, len(self._window))
        if self._new >= self.window and not (transition.terminated or transition.truncated):
            await self._compress()

    async def end_episode(self, trajectory: Trajectory) -> None:
        """What is left is compressed, with the result, when the next episode begins; else the result is a note, now."""
        if self.services.carried and trajectory.transitions:
            end = Step.end(trajectory, self.services)
            if self._new:
                self._window.append(end)
                self._new += 1
            else:
                self._put(
                    Entry(self.services.new_id(), result(end), end.time, {"keywords": [], "names": [], "topic": ""})
                )

    def novelty(self, text: str, before: list[str]) -> float:
        """How new a text is beside others: 0 (one of them) to 1 (also where there are none)."""
        if not before:
            return 1.0
        known = {name for other in before for name in names_in(other)}
        names = names_in(text)
        fresh = len(names - known) / max(1, len(names))
        vectors = self.entries.embed([text, *before])
        nearest = min(1.0, max(float(vectors[0] @ other) for other in vectors[1:]))
        return self.weight * fresh + (1 - self.weight) * (1 - nearest)

    async def _compress(self) -> None:
        """One call over the window; what it wrote, and what that brought together."""
        parse = json_of({"notes": list[Note]}, repairs=self.repairs, whole=False)
        answer = await self.services.ask("compress", self._compression(), self.answer_tokens, parse)
        at = self._window[-1].time
        if answer.value is None:
            self._new = 0
            return
        again = [step for step in self._window if not step.ends][-self.overlap :] if self.overlap else []
        self._window, self._new = again, 0
        added = []
        for note in answer.value["notes"][: self.max_notes]:
            text = one_line(note.text)
            if text and not self.entries.confirm(text, at):
                added.append(Entry(self.services.new_id(), text, at, data_of(note)))
                self._put(added[-1])
        if self.consolidate:
            await self._merge([e for e in added if e.id in self.entries])

    def _compression(self) -> tuple[Message, ...]:
        task = task_of(self._task, self.task_tokens, self.services)
        newest = list(self.entries)[-self.context :] if self.context else []
        now = self._window[-1].time
        parts = ["\n".join([NOTES, *(dated(e, now) for e in newest)])] if newest else []
        parts.append(f"{STEPS}\n{told(self._window)}")
        return (
            system(COMPRESS.format(task=task, most=self.max_notes, words=self.answer_tokens // 2)),
            user("\n\n".join(parts)),
        )

    async def _merge(self, added: list[Entry]) -> None:
        """The largest cluster around a new note becomes one note; its members go into the archive."""
        clusters = [self.cluster_of(entry) for entry in added]
        largest = max(clusters, key=len, default=[])
        if len(largest) < self.cluster:
            return
        now = self.services.time()
        notes = "\n".join([NOTES, *(dated(e, now) for e in largest)])
        parse = json_of(Note, repairs=self.repairs)
        answer = await self.services.ask("merge", (system(MERGE), user(notes)), self.answer_tokens, parse)
        if answer.value is None or not one_line(answer.value.text):
            return
        data = data_of(answer.value)
        for name in ("keywords", "names"):
            data[name] = list(dict.fromkeys([*data[name], *(n for e in largest for n in e.data[name])]))
        for entry in largest:
            self.entries.remove(entry.id)
        self._named.rebuild(self.entries)
        self.archive = [*self.archive, *largest][-self.capacity :]
        latest = max(largest, key=lambda e: e.time.total).time
        self._put(Entry(self.services.new_id(), one_line(answer.value.text), latest, data))

    def cluster_of(self, entry: Entry) -> list[Entry]:
        """A note and those whose affinity to it is great enough, oldest first."""
        near = [(e, score) for e, score in self.entries.near(entry.text, SEMANTIC) if e.id != entry.id]
        return sorted(
            [entry, *(e for e, score in near if self.affinity_of(entry, e, score) >= self.affinity)],
            key=lambda e: (e.time.total, e.id),
        )

    def affinity_of(self, a: Entry, b: Entry, cosine: float) -> float:
        """Affinity of two notes: likeness in meaning and in time."""
        return self.beta * cosine + (1 - self.beta) * math.exp(-self.decay * abs(a.time.total - b.time.total))

    def _put(self, entry: Entry) -> None:
        before = self.entries.evicted
        self.entries.put(entry)
        self._named.add(entry)
        if self.entries.evicted != before:
            self._named.rebuild(self.entries)

    # -- state -----------------------------------------------------------------------------------------------------

    def metrics(self) -> dict[str, int]:
        """Notes, archived ones, evictions, steps that the gate dropped, and notes with pronouns or relative times."""
        return {
            "entries": len(self.entries),
            "archived": len(self.archive),
            "evicted": self.entries.evicted,
            "dropped": self._dropped,
            "vague": sum(is_vague(e.text) for e in self.entries),
        }

    def snapshot(self) -> bytes:
        archive = joined(e.json for e in self.archive)
        flags = [self._new, self._left, self._dropped, self._task]
        window = joined(s.json for s in self._window)
        return dump_state([self.entries.state(), archive, window, self._before, self._lines, flags])

    def restore(self, blob: bytes) -> None:
        entries, archive, window, self._before, self._lines, flags = load_state(blob)
        self._new, self._left, self._dropped, self._task = flags
        self.entries.load(entries)
        self.archive = [Entry.load(row) for row in archive]
        self._window = [Step.load(s) for s in window]
        self._named.rebuild(self.entries)
