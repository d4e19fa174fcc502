"""Generative Agent Memory (Park et al., 2023, arXiv 2304.03442): recency, importance and relevance; and reflection.

Everything that happens is a memory. `top` memories are recalled by the sum of recency, importance and relevance (see
`agentspec.memory.generative.stream`), and being recalled makes them recent again. Two variants of importance:

- `importance: reward` (the default): the reward of the step, no model call. This is AgentSpec's own form and the row
  *Generative Agent Memory* of its tables (on its site `ranked`: weights 0.4, 0.4 and 0.2, at most 500 memories).
- `importance: llm`: the model's rating from 1 to 10, weights 1, 1, 1, and reflection: the Generative Agents paper.

*Reflection* (with `llm` on by default): once the importance of new events sums to `threshold`, the model asks
`questions` of its newest memories; for each, what is recalled is put before it as numbered statements, and it draws
`insights` with the statements they rest on. These are stored as thoughts, recalled and reflected on like events.
Numbers of statements that were not shown are dropped, and an insight without any evidence is not kept. An insight is
rated in the same answer (the paper asks again); under `importance: reward` it has the mean importance of its evidence.

An answer that cannot be read leaves events at the middle rating, and a reflection without its insights. What is left to
rate at an episode's end is rated when the next one of the run begins. Presets: `paper` (`llm`: one rating a step, a
reflection of four calls every 150 points) and `rl` (ratings of 8 steps in one call, a reflection of two calls).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import system, user
from agentspec.memory.generative import prompts
from agentspec.memory.generative.stream import Memory, Stream, Weights
from agentspec.memory.parts import telling
from agentspec.memory.parts.steps import first_told
from agentspec.parameters import at_least, one_of, settings
from agentspec.prompting import failure_reason
from agentspec.protocols import Services
from agentspec.registry import SpecError
from agentspec.state import dump_state, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text, excerpt
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Experience, Recall, Task, Transition

PRESETS = {
    "paper": {"every": 1, "top": 5, "questions": 3, "insights": 5, "task_tokens": 1024, "repairs": 1},
    "rl": {"every": 8, "top": 5, "questions": 1, "insights": 3, "task_tokens": 192, "repairs": 0},
}
WEIGHTS = {"reward": (0.4, 0.2, 0.4), "llm": (1.0, 1.0, 1.0)}
"""Weights of recency, importance and relevance, by kind of importance."""

LOWEST, MIDDLE, HIGHEST = 1, 5, 10
THOUGHT = "Conclusion: {text}"
RECENT = 100
"""Newest memories that questions are asked of."""


@dataclass(frozen=True)
class Insight:
    """A conclusion, the numbers of the statements it rests on, and how important it is."""

    text: str
    evidence: tuple[int, ...]
    importance: int = MIDDLE


class GenerativeMemory:
    """A stream of events and thoughts, recalled by recency, importance and relevance.

    Args:
        preset: `paper` or `rl`; see the module's docstring. The parameters that it sets are `None` here.
        importance: `reward` or `llm`.
        reflection: whether thoughts are drawn (`None`: with `importance: llm`).
        every: steps that are rated in one call.
        top: memories recalled.
        weight_recency, weight_importance, weight_relevance: `None`: 0.4, 0.2, 0.4 with `reward`, 1 each with `llm`.
        decay: what recency keeps per step (the paper's 0.995 is per hour of its game).
        threshold: importance of new events at which reflection begins.
        questions: questions of a reflection, each a call.
        insights: most thoughts per question.
        evidence: memories that are recalled for a question.
        max_memories: most memories; the one used longest ago goes first.
        entry_tokens: most tokens of a memory where it is shown.
        stream_tokens: most tokens of the memories in the prompts of a reflection.
        task_tokens: most tokens of the task's instruction in a prompt.
        answer_tokens: room for an answer.
        repairs: further calls for an answer that cannot be read (0 or 1).
    """

    declaration = Declaration(
        "recency, importance (reward: no model call; or rated) and relevance; reflection where it is rated",
        calls=CallProfile(retrieve=(0, 2), store=(0, 10)),
        rl=CallProfile(retrieve=(0, 1), store=(0, 3)),
        purposes={
            "rate": Purpose("store", '{"ratings": [6]}'),
            "question": Purpose(
                "store", '{"questions": ["Which operation grows fastest?", "What ends it?", "Why so?"]}'
            ),
            "conclude": Purpose(
                "store", '{"insights": [{"text": "DOUBLE() grows fastest.", "evidence": [1], "importance": 7}]}'
            ),
        },
        needs=("embedder",),
        small=(
            {"importance": "llm", "threshold": 12, "max_memories": 6},
            {"reflection": True, "threshold": 0.0, "repairs": 0, "questions": 1},
        ),
        aliases=("ranked",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        importance: str = "reward",
        reflection: bool | None = None,
        every: int | None = None,
        top: int | None = None,
        weight_recency: float | None = None,
        weight_importance: float | None = None,
        weight_relevance: float | None = None,
        decay: float = 0.995,
        threshold: float = 150.0,
        questions: int | None = None,
        insights: int | None = None,
        evidence: int = 20,
        max_memories: int = 500,
        entry_tokens: int = 96,
        stream_tokens: int = 1536,
        task_tokens: int | None = None,
        answer_tokens: int = 384,
        repairs: int | None = None,
    ) -> None:
        given = {"every": every, "top": top, "questions": questions, "insights": insights}
        chosen: dict[str, int] = settings(
            "generative", PRESETS, preset, {**given, "task_tokens": task_tokens, "repairs": repairs}
        )
        one_of("generative", importance=(importance, tuple(WEIGHTS)))
        positive = {name: value for name, value in chosen.items() if name not in ("repairs", "task_tokens")}
        at_least("generative", 1, evidence=evidence, max_memories=max_memories, entry_tokens=entry_tokens, **positive)
        at_least("generative", 1, stream_tokens=stream_tokens, answer_tokens=answer_tokens)
        if not 0 < decay <= 1 or chosen["repairs"] not in (0, 1):
            raise SpecError(f"generative: decay={decay} must lie in (0, 1] and repairs={chosen['repairs']} be 0 or 1")
        self.services = services
        self.rated = importance == "llm"
        self.reflects = self.rated if reflection is None else reflection
        self.every, self.top = chosen["every"], chosen["top"]
        self.questions, self.insights, self.evidence = chosen["questions"], chosen["insights"], evidence
        self.threshold = threshold
        self.entry_tokens, self.stream_tokens = entry_tokens, stream_tokens
        self.task_tokens, self.answer_tokens, self.repairs = chosen["task_tokens"], answer_tokens, chosen["repairs"]
        defaults = zip((weight_recency, weight_importance, weight_relevance), WEIGHTS[importance], strict=True)
        recency, share, relevance = (default if value is None else value for value, default in defaults)
        weights = Weights(recency, share, relevance, decay)
        self.stream = Stream(services.embedder, weights, max_memories)
        self._unrated: list[int] = []
        self._sum = 0.0  # importance of events since the last reflection
        self._due = False
        self._instruction = ""  # that the newest event followed
        self._reflections = 0

    def begin_episode(self, task: Task) -> None:
        self._due = bool(self._unrated)

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """The best memories, best first; each counts as used now."""
        if self._due:
            self._due = False
            await self._rate()
        now, context = self.services.time(), self.services.context
        said = [input.text, *(message.text for message in context.messages)]

        def untold(memory: Memory) -> bool:
            """Not one of the steps that the conversation tells; a failure whose reason it does not give is recalled."""
            held = memory.episode == now.episode and memory.step >= first_told(self.services)
            return not held or (memory.failed and not any(failure_reason(memory.line) in text for text in said))

        where = untold if context.told else None
        found = self.stream.recall(input.text, k or self.top, now.total, where=where)
        texts = [self._shown(memory) for memory, _ in found]
        return telling.listed([*([telling.NOTES] if texts else []), *texts], self.services.llm.module)

    async def store(self, transition: Transition) -> None:
        seen = Experience.of(transition)
        self._instruction = transition.input.instruction
        state = excerpt(seen.state, 4 * self.entry_tokens, self._count)
        now = self.services.time()
        event = Memory(
            self.services.new_id(), seen.line(), state, now.episode, step=transition.step, failed=not seen.ok
        )
        self.stream.add(event, MIDDLE if self.rated else seen.reward, now.total)
        if self.rated:
            self._unrated = [*self._unrated, event.id][-2 * self.every :]
        else:
            self._sum += max(0.0, seen.reward)
        if transition.terminated or transition.truncated:
            return  # what is asked now helps nobody in this episode
        if self.rated and len(self._unrated) >= self.every:
            await self._rate()
        if self.reflects and self._sum >= self.threshold:
            await self._reflect()

    async def end_episode(self, trajectory: Trajectory) -> None:
        """How the episode ended is an event, too; without ratings it is worth what the last step brought."""
        if not (self.services.carried and trajectory.transitions):
            return
        now = self.services.time()
        ended = Memory(self.services.new_id(), telling.outcome(trajectory), "", now.episode)
        self.stream.add(ended, MIDDLE if self.rated else trajectory.transitions[-1].reward, now.total)
        if self._unrated:  # no call is made for this alone
            self._unrated.append(ended.id)

    # -- importance and reflection ---------------------------------------------------------------------------------

    async def _rate(self) -> None:
        """Rate the events that wait; those that get no rating stay in the middle."""
        waiting, self._unrated = [id for id in self._unrated if id in self.stream], []
        if not waiting:
            return
        events = telling.numbered(self._shown(self.stream[id]) for id in waiting)
        prompt = (
            system(prompts.RATE.format(task=self._task())),
            user(prompts.EVENTS.format(events=events, count=len(waiting))),
        )
        parse = json_of({"ratings": list[int]}, repairs=self.repairs)
        answer = await self.services.ask("rate", prompt, 32 + 8 * len(waiting), parse)
        ratings = answer.value["ratings"] if answer.value is not None else []
        for id, rating in zip(waiting, ratings, strict=False):
            self.stream.rate(id, _bounded(rating))
        self._sum += sum(self.stream.importance(id) for id in waiting)

    async def _reflect(self) -> None:
        """Ask questions of the newest memories, and draw conclusions from what is recalled for each."""
        self._sum = 0.0
        self._reflections += 1
        task = self._task()
        newest = [self._shown(memory) for memory in list(self.stream)[-RECENT:]]
        memories = "\n".join(telling.newest_that_fit(newest, self.stream_tokens, self._count))
        prompt = (
            system(prompts.ASK.format(count=self.questions, task=task)),
            user(prompts.NEWEST.format(memories=memories)),
        )
        parse = json_of({"questions": list[str]}, repairs=self.repairs, whole=False)
        answer = await self.services.ask("question", prompt, self.answer_tokens, parse)
        asked = answer.value["questions"] if answer.value is not None else []
        for question in [q for text in asked if (q := " ".join(text.split()))][: self.questions]:
            await self._conclude(task, clip_text(question, self.entry_tokens, self._count))

    async def _conclude(self, task: str, question: str) -> None:
        now = self.services.time().total
        found = [memory for memory, _ in self.stream.recall(question, self.evidence, now)]
        texts = telling.within([self._shown(memory) for memory in found], self.stream_tokens, self._count)
        prompt = (
            system(prompts.CONCLUDE.format(count=self.insights, task=task)),
            user(prompts.STATEMENTS.format(statements=telling.numbered(texts), question=question)),
        )
        parse = json_of({"insights": list[Insight]}, repairs=self.repairs, whole=False)
        answer = await self.services.ask("conclude", prompt, self.answer_tokens, parse)
        for insight in (answer.value["insights"] if answer.value is not None else [])[: self.insights]:
            rests_on = [found[n - 1].id for n in dict.fromkeys(insight.evidence) if 1 <= n <= len(texts)]
            line = clip_text(" ".join(insight.text.split()), self.entry_tokens, self._count)
            if line and rests_on:
                self._think(line, rests_on, insight.importance)

    def _think(self, line: str, evidence: list[int], importance: int) -> None:
        """Store a thought, unless it is word for word one that is there."""
        if any(memory.thought and memory.line == line for memory in self.stream):
            return
        known = [self.stream.importance(id) for id in evidence if id in self.stream]
        worth = _bounded(importance) if self.rated or not known else sum(known) / len(known)
        thought = Memory(self.services.new_id(), line, thought=True, evidence=evidence)
        self.stream.add(thought, worth, self.services.time().total)

    def _shown(self, memory: Memory) -> str:
        if memory.thought:
            return THOUGHT.format(text=memory.line)
        when = telling.when(memory.episode, self.services.time().episode)
        return when + telling.course([[memory.state, memory.line]], self.entry_tokens, self._count)

    def _task(self) -> str:
        return clip_text(self._instruction.strip(), self.task_tokens, self._count) or "(not told)"

    def _count(self, text: str) -> int:
        return self.services.llm.count_tokens(text)

    # -- state -----------------------------------------------------------------------------------------------------

    def metrics(self) -> dict[str, Any]:
        """Memories, how many of them are thoughts, reflections so far, and memories that had to go."""
        thoughts = sum(memory.thought for memory in self.stream)
        reflected = {"thoughts": thoughts, "reflections": self._reflections}
        return {"memories": len(self.stream), **reflected, "evicted": self.stream.evicted}

    def snapshot(self) -> bytes:
        flags = [self._sum, self._due, self._reflections, self._instruction]
        return dump_state([self.stream.state(), self._unrated, flags])

    def restore(self, blob: bytes) -> None:
        stream, self._unrated, flags = load_state(blob)
        self._sum, self._due, self._reflections, self._instruction = flags
        self.stream.load(stream)


def _bounded(rating: int) -> float:
    return float(min(HIGHEST, max(LOWEST, rating)))
