"""A-Mem (Xu et al., 2025, arXiv 2502.12110): notes that describe themselves, link to each other, and evolve.

A note is what happened (`every` steps), keywords, a sentence of context, tags, links to other notes, when it was
written and last recalled, how often, and what it said before it evolved. *Write*, two calls: (1) the model gives
keywords, context and tags; (2) it is shown the `neighbours` nearest notes, under their ids, and decides whether the
memory evolves: the new note gets links and tags, and old notes get a new context and new tags. *Read*, no call: the
`top` notes nearest to the state, then the notes that these link to.

Faults of the authors' code are not here: notes are named by ids that never change (there, a rank was used as an index,
and the wrong notes changed), ids that were not shown change nothing, and a note that changed is embedded again at once,
not after a hundred evolutions. Links are directed, from the new note to older ones, and followed that way.

An answer that cannot be read leaves a plain note without what it was to give; the note is never lost. The note of an
episode's end is described when the next episode of the run begins. Presets: `paper` (a note and two calls a step) and
`rl` (a note and two calls every 6 steps, no repairs). At most `capacity` notes are kept: the one that was written or
recalled longest ago goes first.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, system, user
from agentspec.memory.amem import prompts
from agentspec.memory.amem.notes import Analysis, Evolution, Note, id_of, words
from agentspec.memory.parts import telling
from agentspec.memory.parts.steps import first_told
from agentspec.parameters import at_least, settings
from agentspec.protocols import Services
from agentspec.retrieval import VectorIndex
from agentspec.state import dump_state, joined, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text, excerpt
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Experience, Recall, RecallItem, Task, Transition

PRESETS = {
    "paper": {"every": 1, "top": 10, "step_tokens": 256, "note_tokens": 96, "answer_tokens": 384, "repairs": 1},
    "rl": {"every": 6, "top": 2, "step_tokens": 64, "note_tokens": 200, "answer_tokens": 160, "repairs": 0},
}
MOST_HISTORY = 4
"""Earlier contexts that a note remembers."""


class AMem:
    """Notes that link to each other and evolve.

    Args:
        preset: `paper` or `rl`; see the module's docstring. The parameters that it sets are `None` here.
        every: steps in a note.
        top: notes recalled by similarity; linked notes come on top of these, at most as many again.
        neighbours: nearest notes that a new one is held against.
        step_tokens: most tokens of a step's state in a note.
        note_tokens: most tokens of a note's content where it is recalled or shown as a neighbour.
        answer_tokens: room for an answer.
        repairs: further calls for an answer that cannot be read (0 or 1).
        capacity: most notes.
    """

    declaration = Declaration(
        "notes with keywords, context and tags that link to each other and change old notes",
        calls=CallProfile(retrieve=(0, 4), store=(0, 4)),
        rl=CallProfile(retrieve=(0, 2), store=(0, 2)),
        purposes={
            "analyse": Purpose("store", '{"keywords": ["step"], "context": "It grew fast.", "tags": ["progress"]}'),
            "evolve": Purpose(
                "store",
                '{"evolve": true, "links": ["n0"], "tags": ["progress"], '
                '"neighbours": [{"id": "n0", "context": "The first step.", "tags": ["start"]}]}',
            ),
        },
        needs=("embedder",),
        small=({"every": 2, "capacity": 3}, {"top": 2}),
        aliases=("a-mem", "a_mem"),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        every: int | None = None,
        top: int | None = None,
        neighbours: int = 5,
        step_tokens: int | None = None,
        note_tokens: int | None = None,
        answer_tokens: int | None = None,
        repairs: int | None = None,
        capacity: int = 2000,
    ) -> None:
        given = {"every": every, "top": top, "step_tokens": step_tokens, "note_tokens": note_tokens}
        given |= {"answer_tokens": answer_tokens}
        chosen: dict[str, int] = settings("amem", PRESETS, preset, {**given, "repairs": repairs})
        positive = {name: value for name, value in chosen.items() if name != "repairs"}
        at_least("amem", 1, neighbours=neighbours, capacity=capacity, **positive)
        at_least("amem", 0, repairs=chosen["repairs"])
        self.services = services
        self.every, self.top, self.neighbours = chosen["every"], chosen["top"], neighbours
        self.step_tokens, self.note_tokens, self.answer_tokens = (
            chosen["step_tokens"],
            chosen["note_tokens"],
            chosen["answer_tokens"],
        )
        self.repairs = min(1, chosen["repairs"])
        self.capacity = capacity
        self._index = VectorIndex(services.embedder) if services.embedder else None
        self._notes: dict[int, Note] = {}
        self._open: list[list[str]] = []  # steps of the note to come
        self._plain: list[int] = []  # notes of an episode's end that wait to be described
        self._due = False
        self._evolved = 0

    @property
    def notes(self) -> tuple[Note, ...]:
        """All notes, oldest first."""
        return tuple(self._notes.values())

    def begin_episode(self, task: Task) -> None:
        self._due = bool(self._plain)

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """The nearest notes, best first, then those they link to; and the steps of the note that is not written yet."""
        if self._due:
            self._due = False
            waiting, self._plain = self._plain, []
            for id in waiting:
                if id in self._notes:
                    await self._write(self._notes[id])
        source = self.services.llm.module
        texts = [self._shown(note) for note in self._found(input.text, k or self.top)]
        recall = telling.listed([*([telling.NOTES] if texts else []), *texts], source)
        lines = [RecallItem(line, kind="step", source=source, priority=i) for i, (_, line) in enumerate(self._open)]
        return Recall((*recall.items, *lines))

    async def store(self, transition: Transition) -> None:
        seen = Experience.of(transition)
        self._open.append([excerpt(seen.state, self.step_tokens, self._count), seen.line()])
        if len(self._open) < self.every:
            return
        note = self._keep()
        if transition.terminated or transition.truncated:
            self._plain = [note.id]
        else:
            await self._write(note)

    async def end_episode(self, trajectory: Trajectory) -> None:
        """The steps that are left are a note; it is described when the next episode of the run begins."""
        if not trajectory.transitions:
            return
        ended = telling.outcome(trajectory)
        if self._open:
            self._open.append(["", ended])
            self._plain = [self._keep().id]
        elif self._notes:
            note = self.notes[-1]
            self._change(note, steps=[*note.steps, ["", ended]])

    # -- writing ---------------------------------------------------------------------------------------------------

    def _keep(self) -> Note:
        """A plain note of the open steps; over capacity the one used longest ago goes."""
        now = self.services.time().total
        note = Note(self.services.new_id(), self._open, now, self.services.time().episode, used=now)
        self._open = []
        while len(self._notes) >= self.capacity:
            oldest = min(self._notes.values(), key=lambda n: (n.used, n.id))
            del self._notes[oldest.id]
            if self._index is not None:
                self._index.remove(oldest.id)
        return self._change(note)

    def _change(self, note: Note, **fields: Any) -> Note:
        """The note with other fields, in place of the one with its id."""
        note = self._notes[note.id] = replace(self._notes.get(note.id, note), **fields)
        if self._index is not None:
            self._index.put(note.id, note.text())
        return note

    async def _write(self, note: Note) -> None:
        """Describe a note, then let it and its neighbours evolve."""
        content = telling.course(note.steps, len(note.steps) * (self.step_tokens + 64), self._count)
        words_left = self.answer_tokens // 2
        shown = prompt(prompts.ANALYSE, prompts.NOTE.format(note=content), prompts.FILED.format(words=words_left))
        analysed = await self.services.ask(
            "analyse", shown, self.answer_tokens, json_of(Analysis, repairs=self.repairs, whole=False)
        )
        if analysed.value is not None:
            keywords, tags = words(analysed.value.keywords), words(analysed.value.tags)
            note = self._change(note, keywords=keywords, tags=tags, context=self._line(analysed.value.context))
        near = self._near(note)
        if not near:
            return
        listed = "\n\n".join(map(self._shown, near))
        shown = prompt(
            prompts.EVOLVE,
            prompts.NEAREST.format(notes=listed),
            prompts.NEW.format(note=note.described(content)),
            prompts.DECIDED.format(words=words_left),
        )
        answer = await self.services.ask(
            "evolve", shown, self.answer_tokens, json_of(Evolution, repairs=self.repairs, whole=False)
        )
        if answer.value is not None and answer.value.evolve:
            self._evolve(note, near, answer.value)

    def _evolve(self, note: Note, near: list[Note], change: Evolution) -> None:
        """Carry out a decision about `note` and the notes that were shown; ids of others are passed over."""
        shown = {other.id: other for other in near}
        links = dict.fromkeys(id_of(name) for name in change.links)
        self._change(note, links=[id for id in links if id in shown], tags=words(change.tags) or note.tags)
        for wanted in change.neighbours:
            other = shown.get(id_of(wanted.id))
            if other is None:
                continue
            other = self._notes[other.id]  # as an earlier item of the answer has left it
            context = self._line(wanted.context) or other.context
            replaced = [other.context] if other.context not in ("", context) else []
            history = [*other.history, *replaced][-MOST_HISTORY:]
            self._change(other, context=context, tags=words(wanted.tags) or other.tags, history=history)
            self._evolved += 1

    # -- reading ---------------------------------------------------------------------------------------------------

    def _near(self, note: Note) -> list[Note]:
        found = self._index.similar(note.id, self.neighbours) if self._index is not None else []
        return [self._notes[id] for id, _ in found]

    def _found(self, text: str, top: int) -> list[Note]:
        """The `top` nearest notes and at most as many that they link to; all of them count as recalled."""
        where = self._untold if self.services.context.told else None
        nearest = [id for id, _ in self._index.search(text, top, where=where)] if self._index is not None else []
        links = [id for near in nearest for id in self._notes[near].links if id in self._notes]
        linked = [id for id in links if id not in nearest and (where is None or where(id))]
        found = [self._notes[id] for id in [*nearest, *list(dict.fromkeys(linked))[:top]]]
        now = self.services.time().total
        for note in found:
            self._notes[note.id] = replace(note, recalled=note.recalled + 1, used=now)
        return found

    def _untold(self, id: int) -> bool:
        """Whether a note has any step that the conversation does not tell."""
        note, now = self._notes[id], self.services.time()
        begun = note.written - (now.total - now.step) - len(note.steps)
        return note.episode != now.episode or begun < first_told(self.services)

    def _shown(self, note: Note) -> str:
        when = telling.when(note.episode, self.services.time().episode)
        return note.described(when + telling.course(note.steps, self.note_tokens, self._count))

    def _line(self, text: str) -> str:
        return clip_text(" ".join(text.split()), self.note_tokens, self._count)

    def _count(self, text: str) -> int:
        return self.services.llm.count_tokens(text)

    # -- state -----------------------------------------------------------------------------------------------------

    def metrics(self) -> dict[str, int]:
        """Notes, links between them, and how often an old note was changed."""
        return {"notes": len(self._notes), "links": sum(len(n.links) for n in self.notes), "evolved": self._evolved}

    def snapshot(self) -> bytes:
        order = list(self._index) if self._index is not None else []
        notes = joined(note.json for note in self._notes.values())
        return dump_state([notes, order, self._open, self._plain, self._due, self._evolved])

    def restore(self, blob: bytes) -> None:
        notes, order, self._open, self._plain, self._due, self._evolved = load_state(blob)
        self._notes = {row[0]: Note(*row) for row in notes}
        if self._index is not None:
            self._index.load([(id, self._notes[id].text()) for id in order])


def prompt(role: str, *parts: str) -> tuple[Message, ...]:
    """What is asked, then what it is asked about."""
    return system(role), user("\n\n".join(parts))
