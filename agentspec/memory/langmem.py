"""LangMem (LangChain, 2025), native: semantic, episodic and procedural memory with a JSON protocol of our own.

The library's memory manager shows the model what was said and the `query_limit` nearest memories, and lets it insert,
patch and delete them. *Semantic* memory is a collection of facts; *episodic* memory holds episodes as observation,
thoughts, action and result; *procedural* memory is the agent's own instructions, rewritten by a prompt optimiser from
trajectories and what they earned. All three are here, without tool calls, so that small models can use them and every
call can be trained.

AgentSpec's form: facts are edited every `every` steps (the library's hot path after each step is `every: 1`, its
debounced background form a larger number); an experience is written, and the instructions are optimised, every
`episode_every` steps and at an episode's end where a later one follows. Facts and experiences are found by similarity
to the observation; instructions are always shown, and change only by the optimiser's answer. Cost per step: none to
retrieve, 1 call per `every` steps, 2 (side by side) per `episode_every`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any, Literal

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.memory.parts.steps import (
    DATA,
    goal_of,
    newest_steps,
    newest_within,
    step_name,
    step_text,
    written,
)
from agentspec.memory.parts.telling import outcome
from agentspec.parameters import at_least, settings
from agentspec.protocols import Services
from agentspec.registry import SpecError
from agentspec.retrieval import VectorIndex
from agentspec.state import Record, dump_state, keyed, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, RecallItem, Task, Transition

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"every": 1, "episode_every": 10, "answer_tokens": 256},
    "rl": {"every": 8, "episode_every": 24, "answer_tokens": 192},
}
TYPES = ("semantic", "episodic", "procedural")
UNCHANGED = "NO_CHANGE"
EDITS = 4

HEAD = "You manage the memory of an agent that acts in an environment.\n\nTask: {task}\n\n" + DATA + "\n{steps}"
SEMANTIC = (
    "\n\nFacts on record that may be about the same:\n{facts}\n\nKeep the record of facts true: insert what is new and "
    "will matter later, patch (put a new text in place of the fact of that id) what has changed, delete what proved "
    "wrong. One fact per entry, complete in itself, with numbers, ids and places. At most {most} edits and "
    "{words} words in all, none if nothing is new. Answer with JSON:\n"
    '{{"edits": [{{"op": "insert" | "patch" | "delete", "id": number or null, "text": fact}}]}}'
)
EPISODIC = (
    "\n\nWrite these steps down as one experience to learn from, in at most {words} words. Answer with JSON:\n"
    '{{"observation": what the situation was, "thoughts": what mattered in it, "action": what was done, '
    '"result": what came of it, with numbers, and what would have been better}}'
)
PROCEDURAL = (
    "\n\nThe agent follows these instructions of its own:\n{instructions}\n\nImprove them in the light of the steps "
    "and their rewards: keep what works, correct what failed, add what was missing. At most {words} words, short "
    "imperative sentences with numbers. Write the new instructions and nothing else, or NO_CHANGE."
)


@dataclass(frozen=True)
class Edit:
    """One edit of the collection of facts."""

    op: Literal["insert", "patch", "delete"]
    id: int | None = None
    text: str = ""


@dataclass(frozen=True)
class Episode(Record):
    """An experience: the situation, what mattered, what was done, what came of it."""

    observation: str
    thoughts: str
    action: str
    result: str

    @property
    def text(self) -> str:
        """The experience as one line."""
        return f"{self.observation} | {self.thoughts} | {self.action} -> {self.result}"


class LangMem:
    """Facts, episodes and instructions.

    Args:
        preset: `paper` (facts after every step, as the library's hot path) or `rl` (every 8 steps).
        types: which of `semantic`, `episodic`, `procedural` are kept.
        every: steps between edits of the facts.
        episode_every: steps between experiences, and between optimisations of the instructions (0: only at the end).
        query_limit: facts that are shown to the manager, and to the agent.
        episodes: experiences that are shown to the agent.
        recent: newest steps that are shown before all else, where the prompt does not tell them anyway (0: none);
            older ones of which no facts have been made yet are shown where there is room.
        max_facts: most facts; the one written longest ago goes first.
        max_episodes: most experiences; the oldest go first.
        entry_tokens: most tokens of a fact, and of each field of an experience.
        instruction_tokens: most tokens of the instructions.
        state_tokens: most tokens of the state kept with a step.
        answer_tokens: most tokens of an answer.
        steps_tokens: most tokens of steps in a prompt.
    """

    declaration = Declaration(
        "facts, experiences and instructions of its own",
        calls=CallProfile(store=(0, 5), episode=(0, 5)),
        rl=CallProfile(store=(0, 5), episode=(0, 5)),
        purposes={
            "semantic": Purpose("store", '{"edits": [{"op": "insert", "id": null, "text": "ADD gives 3."}]}'),
            "episodic": Purpose(
                "store",
                '{"observation": "So low.", "thoughts": "Double it.", "action": "DOUBLE() now", "result": "It grew."}',
            ),
            "procedural": Purpose("store", "Double while it is far below."),
        },
        needs=("embedder",),
        small=({"every": 2, "episode_every": 4, "max_facts": 3, "max_episodes": 1},),
        aliases=("lang_mem",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        types: list[str] | None = None,
        every: int | None = None,
        episode_every: int | None = None,
        query_limit: int = 5,
        episodes: int = 1,
        recent: int = 3,
        max_facts: int = 500,
        max_episodes: int = 200,
        entry_tokens: int = 64,
        instruction_tokens: int = 128,
        state_tokens: int = 80,
        answer_tokens: int | None = None,
        steps_tokens: int = 1024,
    ) -> None:
        given = {"every": every, "episode_every": episode_every, "answer_tokens": answer_tokens}
        chosen = settings("langmem", PRESETS, preset, given)
        self.every, self.episode_every = chosen["every"], chosen["episode_every"]
        self.answer_tokens = chosen["answer_tokens"]
        self.types = tuple(types if types is not None else TYPES)
        if not self.types or set(self.types) - set(TYPES):
            raise SpecError(f"langmem: types must be some of {', '.join(TYPES)}; got {list(self.types)}")
        at_least("langmem", 1, every=self.every, max_facts=max_facts, max_episodes=max_episodes)
        at_least("langmem", 0, episode_every=self.episode_every, query_limit=query_limit, recent=recent)
        self.services = services
        self.query_limit, self.shown_episodes, self.recent = query_limit, episodes, recent
        self.max_facts, self.max_episodes = max_facts, max_episodes
        self.entry_tokens, self.instruction_tokens = entry_tokens, instruction_tokens
        self.state_tokens, self.steps_tokens = state_tokens, steps_tokens
        self.facts: dict[int, str] = {}
        self._written: dict[int, int] = {}  # fact -> the episode in which it was written last
        self.episodes: dict[int, Episode] = {}
        self.instructions = ""
        self._steps: list[str] = []  # of this episode, as far back as something is still to be written of them
        self._for_facts, self._for_episode = 0, 0  # of these the newest that are still to be written
        self._task = ""
        self._counts = {"edits": 0, "refused_edits": 0}
        self._build_indices()

    def begin_episode(self, task: Task) -> None:
        self._steps, self._for_facts, self._for_episode = [], 0, 0

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """Instructions, the experience and the facts that fit the observation, the newest steps."""
        items = []
        if self.instructions:
            items.append(RecallItem(f"Instructions of your own: {self.instructions}", kind="procedural", priority=4.0))
        for key, score in self._nearest(self._episode_index, input.text, self.shown_episodes):
            text = f"A past experience: {self.episodes[key].text}"
            items.append(RecallItem(text, score, "episodic", str(key), 1.0 + score))
        for key, score in self._nearest(self._fact_index, input.text, self.query_limit if k is None else k):
            items.append(RecallItem(self._dated(key), score, "semantic", str(key), 2.0 + score))
        if self.recent:
            waiting = self._steps[-max(self.recent, self._for_facts) :]
            items += newest_steps(waiting, self.recent, self.services.llm.count_tokens)
        return Recall(tuple(items))

    async def store(self, transition: Transition) -> None:
        count, now = self.services.llm.count_tokens, self.services.time()
        name = step_name(now.episode, transition.step, now)
        self._steps.append(f"{name}: {step_text(transition, self.state_tokens, count)}")
        self._for_facts, self._for_episode = self._for_facts + 1, self._for_episode + 1
        self._task = goal_of(transition.input.instruction, count)
        if not (transition.terminated or transition.truncated):
            whole = bool(self.episode_every) and self._for_episode >= self.episode_every
            await self._write(facts=self._for_facts >= self.every, whole=whole)

    async def end_episode(self, trajectory: Trajectory) -> None:
        if self.services.carried:
            await self._write(facts=self._for_facts > 0, whole=self._for_episode > 0, ending=outcome(trajectory))

    async def _write(self, *, facts: bool, whole: bool, ending: str = "") -> None:
        """Ask for what is due, side by side, then apply the answers."""
        new, all_steps = self._steps[-self._for_facts :], self._steps[-self._for_episode :]
        work = []
        if facts:
            self._for_facts = 0
            if "semantic" in self.types:
                work.append(self._edit_facts(new, ending))
        if whole:
            self._for_episode = 0
            if "episodic" in self.types:
                work.append(self._write_episode(all_steps, ending))
            if "procedural" in self.types:
                work.append(self._optimise(all_steps, ending))
        await asyncio.gather(*work)
        wanted = self._for_episode if self.episode_every or self.services.carried else 0
        kept = max(self._for_facts, wanted, self.recent)
        self._steps = self._steps[-kept:] if kept else []

    async def _edit_facts(self, steps: Sequence[str], ending: str) -> None:
        near = self._nearest(self._fact_index, " ".join(steps), self.query_limit)
        facts = "\n".join(f"{key}: {self._dated(key)[2:]}" for key, _ in near) or "(none)"
        prompt = self._head(steps, ending) + SEMANTIC.format(facts=facts, most=EDITS, words=self.answer_tokens // 2)
        answer = await self.services.ask(
            "semantic", prompt, self.answer_tokens, json_of({"edits": list[Edit]}, whole=False)
        )
        for edit in answer.value["edits"][:EDITS] if answer.value else ():
            self._apply(edit)

    def _apply(self, edit: Edit) -> None:
        """One edit; one without a text, or of an unknown id, changes nothing and is counted."""
        text = self._clip(edit.text, self.entry_tokens)
        known = edit.id in self.facts
        refused = (edit.op != "delete" and not text) or (edit.op != "insert" and not known)
        if refused or (edit.op == "insert" and text in self.facts.values()):
            self._counts["refused_edits"] += 1
            return
        self._counts["edits"] += 1
        key = self.services.new_id() if edit.op == "insert" or edit.id is None else edit.id
        self.facts.pop(key, None)
        if edit.op == "delete":
            self._fact_index.remove(key) if self._fact_index is not None else None
            return
        self._written[key] = self.services.time().episode
        self._put(self.facts, self._fact_index, key, text, text, self.max_facts)
        self._written = {key: self._written[key] for key in self.facts}

    async def _write_episode(self, steps: Sequence[str], ending: str) -> None:
        prompt = self._head(steps, ending) + EPISODIC.format(words=self.answer_tokens // 2)
        answer = await self.services.ask("episodic", prompt, self.answer_tokens, json_of(Episode))
        if answer.value is not None:
            episode = Episode(*(self._clip(text, self.entry_tokens) for text in astuple(answer.value)))
            key = self.services.new_id()
            self._put(self.episodes, self._episode_index, key, episode, episode.observation, self.max_episodes)

    async def _optimise(self, steps: Sequence[str], ending: str) -> None:
        words = self.instruction_tokens // 2
        prompt = self._head(steps, ending) + PROCEDURAL.format(instructions=self.instructions or "(none)", words=words)
        answer = await self.services.ask("procedural", prompt, self.answer_tokens)
        text = written(answer, self.instruction_tokens, self.services.llm.count_tokens)
        if text and UNCHANGED not in text:
            self.instructions = text

    def _put(
        self, entries: dict[int, Any], index: VectorIndex | None, key: int, entry: Any, text: str, most: int
    ) -> None:
        """Write an entry last; beyond `most` the one written longest ago goes."""
        entries[key] = entry
        if index is not None:
            index.remove(key)
            index.put(key, text)
        while len(entries) > most:
            oldest = next(iter(entries))
            del entries[oldest]
            if index is not None:
                index.remove(oldest)

    def _head(self, steps: Sequence[str], ending: str) -> str:
        shown = newest_within(steps, self.steps_tokens, self.services.llm.count_tokens)
        return HEAD.format(task=self._task, steps="\n".join(shown + ([ending] if ending else [])))

    def _dated(self, key: int) -> str:
        """A fact as the agent reads it; one of an earlier episode says so, for it may be over."""
        episode = self._written[key]
        return f"- {self.facts[key]}" + ("" if episode == self.services.time().episode else f" [episode {episode + 1}]")

    def _clip(self, text: str, tokens: int) -> str:
        return clip_text(" ".join(text.split()), tokens, self.services.llm.count_tokens)

    @staticmethod
    def _nearest(index: VectorIndex | None, query: str, k: int) -> list[tuple[int, float]]:
        return index.search(query, k) if index is not None and k else []

    def _build_indices(self) -> None:
        embedder = self.services.embedder
        self._fact_index = VectorIndex(embedder) if embedder is not None else None
        self._episode_index = VectorIndex(embedder) if embedder is not None else None
        if self._fact_index is not None and self._episode_index is not None:
            self._fact_index.load(list(self.facts.items()))
            self._episode_index.load([(key, episode.observation) for key, episode in self.episodes.items()])

    def describe(self) -> str:
        """Instructions, facts and experiences as one text."""
        facts = [f"{key}: {text}" for key, text in self.facts.items()]
        episodes = [f"{key}: {episode.text}" for key, episode in self.episodes.items()]
        return "\n".join(["Instructions", self.instructions, "Facts", *facts, "Experiences", *episodes])

    def metrics(self) -> Mapping[str, Any]:
        """Facts and experiences there are; edits of facts made and refused so far."""
        return {"facts": len(self.facts), "experiences": len(self.episodes), **self._counts}

    def snapshot(self) -> bytes:
        here = [self._steps, self._for_facts, self._for_episode, self._task]
        facts = [[key, text, self._written[key]] for key, text in self.facts.items()]
        return dump_state([facts, keyed(self.episodes), self.instructions, here, self._counts])

    def restore(self, blob: bytes) -> None:
        facts, episodes, self.instructions, here, self._counts = load_state(blob)
        self.facts = {key: text for key, text, _ in facts}
        self._written = {key: episode for key, _, episode in facts}
        self.episodes = {key: Episode(*values) for key, values in episodes}
        self._steps, self._for_facts, self._for_episode, self._task = here
        self._build_indices()
