"""Zep (Rasmussen et al., 2025, arXiv 2501.13956), the temporal knowledge graph of Graphiti.

Steps become facts between entities ("restaurant 5", "serves", "pizza"), and every fact knows since when it is so and
when it ended, and when that was written. A write is at most three calls: one extracts entities, facts and times
together (with the `context` steps before, to understand the new ones); one says which new names mean known entities,
and is made only where names are alike and not equal; one says which facts repeat or contradict earlier ones about the
same things, and is made only where there are such. Code does the rest: what is contradicted is not deleted but ends
where the other begins (see `agentspec.memory.zep.temporal`), in whatever order they are told.

Retrieval looks facts up by meaning, by words, and along the graph (`hops`) from what the observation names, fuses the
three rankings by reciprocal rank (constant 0, as Graphiti does), and shows each with its times; what is over is marked
so, and ranked as everything else. Communities of entities are found by label propagation between the episodes of a run,
from the labels there are; each that has changed gets a summary, and the summary of the community that the observation
names most is shown first.

`extraction: state` makes no call at all: facts are the fields of the observation's structured state, and a field that
changes contradicts its former value; `both` does both. It is for environments whose state is small and symbolic
(MiniGrid).

AgentSpec's form: steps take the place of messages; time is counted in steps of the run. Entities have no summaries of
their own (their newest facts say the same), a community's is one call instead of one per pair of members. Of the
paper's tables this is the row *ReAct + Zep* (preset `paper`).

Bounded by `capacity` facts (the one written longest ago goes first, with entities that have no other). An extraction
that cannot be read writes nothing and the steps wait, at most `2 * every`; without an answer, alike names are different
things and nothing is contradicted.

Cost: `paper` 1 to 3 calls a step, `rl` every 8 steps; between episodes at most `communities` calls.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import system, user
from agentspec.memory.parts.entries import NOTES, embedder_of, one_line, recalled
from agentspec.memory.parts.steps import written
from agentspec.memory.parts.waiting import Step, result, shown_lines, unwritten
from agentspec.memory.zep.communities import Communities
from agentspec.memory.zep.observed import put, read_state
from agentspec.memory.zep.prompts import COMMUNITY
from agentspec.memory.zep.temporal import TemporalGraph
from agentspec.memory.zep.timeline import Timeline
from agentspec.memory.zep.writing import Writer
from agentspec.parameters import at_least, one_of, settings
from agentspec.services import Services, Time
from agentspec.state import dump_state, joined, load_state
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, Task, Transition

PRESETS = {
    "paper": {
        "every": 1,
        "context": 4,
        "top": 10,
        "least": 0.6,
        "hops": 3,
        "past": True,
        "communities": 4,
        "max_facts": 8,
        "step_tokens": 512,
        "answer_tokens": 768,
        "task_tokens": 512,
        "repairs": 1,
    },
    "rl": {
        "every": 8,
        "context": 2,
        "top": 6,
        "least": 0.3,
        "hops": 2,
        "past": False,
        "communities": 1,
        "max_facts": 5,
        "step_tokens": 80,
        "answer_tokens": 320,
        "task_tokens": 96,
        "repairs": 0,
    },
}

COMMUNITY_FACTS, COMMUNITY_TOKENS = 12, 128


class ZepMemory:
    """A temporal graph of facts.

    Args:
        preset: `paper` or `rl`; see the module's docstring. The parameters that it sets are `None` here.
        extraction: `model`; `state` for facts out of the structured state, without a call; or `both`.
        every: steps between two writes.
        context: earlier steps shown with the new ones.
        top: facts recalled.
        least: smallest cosine similarity of a fact that is found by meaning.
        hops: how far along the graph facts are looked for.
        past: whether facts that are over are recalled, marked as such.
        rerank: `rrf`, `mmr` or `mentions`.
        communities: most summaries of communities written between two episodes (0: no communities).
        max_facts: most facts of a write.
        step_tokens: most tokens of a step in a prompt.
        answer_tokens: most tokens of an answer.
        task_tokens: most tokens of the task's instruction in a prompt.
        repairs: 1 to ask again for an answer that cannot be read, else 0.
        capacity: most facts.
        recent: newest steps shown with them, where the prompt does not tell them anyway.
    """

    declaration = Declaration(
        "a graph of facts that know since when and until when they are so",
        calls=CallProfile(retrieve=(0, 10), store=(0, 6)),
        rl=CallProfile(retrieve=(0, 4), store=(0, 3)),
        purposes={
            "extract": Purpose(
                "store",
                '{"facts": [{"subject": "agent-itself", "relation": "wants", "object": "target", '
                '"fact": "The agent wants the target.", "since": 1}, {"subject": "agent-itself", "relation": "knows", '
                '"object": "place", "fact": "SUB() takes 1 from the number.", "since": null}]}',
            ),
            "same": Purpose("store", '{"same": [{"name": "agent-itself", "known": 0}]}', refers="known"),
            "resolve": Purpose("store", '{"results": [{"fact": 0, "same": null, "contradicts": [0]}]}', refers="fact"),
            "community": Purpose("episode", "SUB() takes 1 from the number, which is below 1000."),
        },
        needs=("embedder",),
        small=(
            {"every": 2, "least": 0.0, "capacity": 6, "rerank": "mmr"},
            {"preset": "rl", "every": 3, "rerank": "mentions", "past": True},
            {"extraction": "both", "every": 2, "capacity": 40, "recent": 0},
            {"extraction": "state"},
        ),
        aliases=("graphiti",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        extraction: str = "model",
        every: int | None = None,
        context: int | None = None,
        top: int | None = None,
        least: float | None = None,
        hops: int | None = None,
        past: bool | None = None,
        rerank: str = "rrf",
        communities: int | None = None,
        max_facts: int | None = None,
        step_tokens: int | None = None,
        answer_tokens: int | None = None,
        task_tokens: int | None = None,
        repairs: int | None = None,
        capacity: int = 2000,
        recent: int = 3,
    ) -> None:
        counts = {"every": every, "top": top, "max_facts": max_facts}
        counts |= {"step_tokens": step_tokens, "answer_tokens": answer_tokens}
        others = {"context": context, "hops": hops, "communities": communities, "task_tokens": task_tokens}
        others |= {"repairs": repairs}
        chosen = settings("zep", PRESETS, preset, counts | others | {"least": least, "past": past})
        at_least("zep", 1, capacity=capacity, **{name: chosen[name] for name in counts})
        at_least("zep", 0, recent=recent, **{name: chosen[name] for name in others})
        one_of("zep", extraction=(extraction, ("model", "state", "both")), rerank=(rerank, ("rrf", "mmr", "mentions")))
        self.services = services
        self.extraction, self.rerank, self.recent = extraction, rerank, recent
        self.every, self.context, self.top, self.least, self.hops, self.past = (
            chosen[name] for name in ("every", "context", "top", "least", "hops", "past")
        )
        self.most_summaries, self.step_tokens, self.answer_tokens = (
            chosen[name] for name in ("communities", "step_tokens", "answer_tokens")
        )
        self.graph, self.timeline = TemporalGraph(embedder_of(services), capacity), Timeline(services)
        sizes = {name: chosen[name] for name in ("max_facts", "answer_tokens", "task_tokens", "repairs")}
        self._writer = Writer(services, self.graph, self.timeline, **sizes)
        self.communities = Communities()
        self._pending: list[Step] = []
        self._lines: list[str] = []
        self._waited = 0
        self._task = ""  # the instruction that the newest step followed
        self._ended = False  # whether an episode has ended since communities were looked for

    def begin_episode(self, task: Task) -> None:
        self._ended = bool(self._pending or len(self.graph.facts))
        self.timeline.begin_episode()
        self._lines, self._waited = [], 0

    # -- recall ----------------------------------------------------------------------------------------------------

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """The best facts with their times; what an earlier episode left is written first."""
        if self._ended:
            self._ended = False
            if unwritten(self._pending):
                await self._write()
            if self.most_summaries:
                await self._communities()
        found = self.graph.search(
            input.text, k or self.top, least=self.least, hops=self.hops, past=self.past, rerank=self.rerank
        )
        notes = [(self.timeline.shown(entry), score) for entry, score in found]
        summary = self.communities.summary_for(self.graph.named_in(input.text))
        notes = [(f"- Of earlier episodes: {summary}", 1.0), *notes] if summary else notes
        lines = shown_lines(self._lines, max(self.recent, len(self._pending)) if self.recent else 0)
        return recalled(notes, lines, self.services.llm.module)

    # -- writing ---------------------------------------------------------------------------------------------------

    async def store(self, transition: Transition) -> None:
        step = Step.of(transition, self.services, self.step_tokens)
        self._lines = [*self._lines, step.line][-max(1, self.recent, self.context + 2 * self.every) :]
        if self.extraction != "model":
            self._read_state(transition.input.state, step.time)
        if self.extraction == "state":
            return
        self._pending = [*self._pending, step][-2 * self.every :]
        self._task = transition.input.instruction
        self._waited += 1
        if self._waited >= self.every and not (transition.terminated or transition.truncated):
            await self._write()

    async def end_episode(self, trajectory: Trajectory) -> None:
        """What is left is written with the result, and communities are found, when the next episode of the run begins.

        Where no model writes facts, or nothing is left, the result is one at once.
        """
        if not (self.services.carried and trajectory.transitions):
            return
        end = Step.end(trajectory, self.services)
        if self.extraction == "state" or not unwritten(self._pending):
            put(self.graph, [(f"episode {end.time.episode + 1}", "result", result(end))], end.time, self.services)
        else:
            self._pending.append(end)

    async def _write(self) -> None:
        """Facts out of the steps that wait; they wait on where no answer can be read."""
        self._waited = 0
        waiting = [s.line for s in self._pending]
        before = [line for line in self._lines if line not in waiting][-self.context :] if self.context else []
        if await self._writer.write(self._pending, before, self._task):
            self._pending = []

    def _read_state(self, state: Mapping[str, Any], at: Time) -> None:
        read_state(self.graph, state, at, self.services)

    # -- communities -----------------------------------------------------------------------------------------------

    async def _communities(self) -> None:
        """Find communities, and sum up those that have changed, the largest first."""
        changed = self.communities.renew(self.graph.graph)[: self.most_summaries]
        summaries = await asyncio.gather(*(self._sum_up(ids) for _, ids in changed))
        for (label, ids), summary in zip(changed, summaries, strict=True):
            if summary:
                self.communities.sum_up(label, ids, summary)

    async def _sum_up(self, ids: list[int]) -> str:
        """The summary of a community; of one that was cut off its whole sentences."""
        facts = sorted(self.graph.of(ids), key=lambda e: -e.time.total)[:COMMUNITY_FACTS]
        shown = "\n".join([NOTES, *(self.timeline.shown(e) for e in reversed(facts))])
        prompt = (system(COMMUNITY), user(shown))
        room = min(COMMUNITY_TOKENS, self.answer_tokens)
        answer = await self.services.ask("community", prompt, room)
        return one_line(written(answer, room, self.services.llm.count_tokens))

    # -- state -----------------------------------------------------------------------------------------------------

    def metrics(self) -> dict[str, int]:
        """Facts, those that are over, entities, communities with a summary, evictions."""
        return {
            "entries": len(self.graph.facts),
            "over": sum(e.data["invalid"] is not None for e in self.graph.facts),
            "entities": len(self.graph.names),
            "communities": len(self.communities),
            "evicted": self.graph.facts.evicted,
        }

    def snapshot(self) -> bytes:
        pending = joined(s.json for s in self._pending)
        flags = [self._waited, self._ended, self.timeline.begins, self._task]
        return dump_state([self.graph.state(), self.communities.state(), pending, self._lines, flags])

    def restore(self, blob: bytes) -> None:
        graph, communities, pending, self._lines, flags = load_state(blob)
        self._waited, self._ended, self.timeline.begins, self._task = flags
        self.graph.load(graph)
        self.communities.load(communities)
        self._pending = [Step.load(s) for s in pending]
