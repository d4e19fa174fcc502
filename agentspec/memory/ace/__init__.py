"""ACE, Agentic Context Engineering (Zhang et al., 2025, arXiv 2510.04618): a playbook that grows by small deltas.

Three roles of one model. The *generator* is the agent's own reasoner: it sees the playbook and the last reflection,
and names the bullets it goes by (`[str-00001]`) where it gives reasons. The *reflector* reads steps, feedback and the
cited bullets; it says what went wrong, why, what is right, what follows, and finds each bullet helpful, harmful or
neutral. The *curator* reads the playbook and the reflections and names what changes. Code carries the deltas out (see
`agentspec.memory.ace.playbook`): the playbook is never rewritten as a whole, which is what a Dynamic Cheatsheet does.

Grow and refine: bullets whose similarity is `dedupe` or more are merged by the model (or, `merge: best`, the best one
stays), counters summed; over its budget the playbook loses what was found harmful at least as often as helpful first.

AgentSpec's form: the paper's unit is a task with an answer that can be tried again; here it is `every` steps, which
cannot, so there is one reflection and no regeneration. What is left at an episode's end is reflected on with its
outcome when the next episode of the run begins: paid for by the episode that can use it. `every: 0` is the paper's
offline adaptation, one reflection per episode, and needs `scope: run`. Deltas are ADD (all that the authors' code has),
UPDATE, MERGE and REMOVE. Presets: `paper` (two calls a step, and merges) and `rl` (two every 8 steps, none to repair or
merge). An answer that cannot be read changes nothing, a delta that cannot be read leaves the others as they are;
a reflection whose curation failed waits for the next one.
"""

from __future__ import annotations

import math
from typing import Literal

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, system, user
from agentspec.memory.ace import prompts
from agentspec.memory.ace.playbook import SECTIONS, Bullet, Operation, Playbook
from agentspec.memory.ace.records import Counts, Review, Waiting
from agentspec.memory.parts import telling
from agentspec.parameters import at_least, one_of, settings
from agentspec.protocols import Services
from agentspec.registry import SpecError
from agentspec.retrieval import Graph, VectorIndex
from agentspec.state import dump_state, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text, excerpt
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, RecallItem, Task, Transition

PRESETS = {
    "paper": {
        "every": 1,
        "playbook_tokens": 4096,
        "step_tokens": 512,
        "task_tokens": 1024,
        "answer_tokens": 512,
        "repairs": 1,
        "merge": "llm",
    },
    "rl": {
        "every": 8,
        "playbook_tokens": 384,
        "step_tokens": 96,
        "task_tokens": 256,
        "answer_tokens": 256,
        "repairs": 0,
        "merge": "best",
    },
}
MOST_OPERATIONS = 8
MOST_MERGES = 3
"""Groups of near-duplicates that one curation merges."""


class ACE:
    """A playbook of bullets that a reflector and a curator refine.

    Args:
        preset: `paper` or `rl`; see the module's docstring. The parameters that it sets are `None` here.
        every: steps between two reflections (0: one per episode, when the next one begins; needs `scope: run`).
        curate_every: reflections between two curations.
        dedupe: cosine similarity from which bullets are merged (0: never, and no embedder is needed).
        merge: who merges them: `llm`, or `best` (the bullet with the greatest balance stays).
        playbook_tokens: most tokens of the playbook. What is shown has the spec's `recall_tokens`, best bullets first.
        bullets: most bullets.
        bullet_tokens: most tokens of a bullet's text.
        step_tokens: most tokens of a step in the reflector's prompt.
        task_tokens: most tokens of the task's instruction in both prompts.
        answer_tokens: room for an answer of the reflector or the curator.
        repairs: further calls for an answer that cannot be read (0 or 1).
    """

    declaration = Declaration(
        "a playbook of bullets with counters, changed by a reflector's and a curator's deltas",
        calls=CallProfile(retrieve=(0, 7), store=(0, 7)),
        rl=CallProfile(retrieve=(0, 2), store=(0, 2)),
        purposes={
            "reflect": Purpose(
                "store",
                '{"correct": "Double the number first.", "insight": "DOUBLE() grows fastest.", '
                '"bullets": [{"id": "str-00000", "tag": "helpful"}]}',
            ),
            "curate": Purpose(
                "store",
                '{"operations": [{"type": "ADD", "section": "STRATEGIES", "content": "DOUBLE() grows it fastest."}, '
                '{"type": "ADD", "section": "FACTS", "content": "DOUBLE() grows it fastest!"}]}',
            ),
            "merge": Purpose("store", "DOUBLE() grows the number fastest; SUB() corrects it."),
        },
        needs=("embedder",),
        waived={"embedder": ("dedupe", 0)},
        small=(
            {"every": 3},
            {"every": 4, "merge": "best", "bullets": 2, "curate_every": 2},
            {"every": 2, "dedupe": 0, "repairs": 0, "playbook_tokens": 40},
        ),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        every: int | None = None,
        curate_every: int = 1,
        dedupe: float = 0.9,
        merge: Literal["llm", "best"] | None = None,
        playbook_tokens: int | None = None,
        bullets: int = 500,
        bullet_tokens: int = 64,
        step_tokens: int | None = None,
        task_tokens: int | None = None,
        answer_tokens: int | None = None,
        repairs: int | None = None,
    ) -> None:
        given = {"every": every, "merge": merge, "playbook_tokens": playbook_tokens, "step_tokens": step_tokens}
        given |= {"task_tokens": task_tokens, "answer_tokens": answer_tokens, "repairs": repairs}
        chosen = settings("ace", PRESETS, preset, given)
        one_of("ace", merge=(chosen["merge"], ("llm", "best")))
        at_least("ace", 0, **{name: chosen[name] for name in ("every", "task_tokens", "repairs")})
        sizes = {name: chosen[name] for name in ("playbook_tokens", "step_tokens", "answer_tokens")}
        at_least("ace", 1, curate_every=curate_every, bullets=bullets, bullet_tokens=bullet_tokens, **sizes)
        if not 0 <= dedupe <= 1 or chosen["repairs"] > 1:
            raise SpecError(f"ace: dedupe={dedupe} must lie in 0..1 and repairs={chosen['repairs']} be 0 or 1")
        self.services = services
        self.every: int = chosen["every"]
        self.curate_every = curate_every
        self.dedupe = dedupe
        self.merge: str = chosen["merge"]
        self.playbook_tokens: int = chosen["playbook_tokens"]
        self.most_bullets, self.bullet_tokens = bullets, bullet_tokens
        self.step_tokens: int = chosen["step_tokens"]
        self.task_tokens: int = chosen["task_tokens"]
        self.answer_tokens: int = chosen["answer_tokens"]
        self.repairs: int = chosen["repairs"]
        self.playbook = Playbook()
        self._index = VectorIndex(services.embedder) if services.embedder and dedupe else None
        self._last = ""
        self._waiting = Waiting()
        self._counts = Counts()

    # -- the generator ---------------------------------------------------------------------------------------------

    def begin_episode(self, task: Task) -> None:
        self._waiting.due = bool(self._waiting.steps)

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """The playbook by sections, its best bullets (of equals the newest) mattering most, and the last review."""
        if self._waiting.due:
            self._waiting.due = False
            await self._adapt()
        source = self.services.llm.module
        shown = self.playbook.ordered()
        if k:
            best = sorted(shown, key=lambda b: (-b.balance, -b.number))[:k]
            shown = [b for b in shown if b in best]
        worth = {b.id: i for i, b in enumerate(sorted(shown, key=lambda b: (b.balance, b.number)))}
        items = [RecallItem(b.line(), float(b.balance), "procedural", source, worth[b.id]) for b in shown]
        head = [RecallItem(prompts.HEADER, kind="procedural", source=source, priority=math.inf)] if items else []
        last = prompts.LAST.format(text=self._last)
        said = [RecallItem(last, kind="summary", source=source, priority=math.inf)] if self._last else []
        return Recall((*head, *items, *said))

    async def store(self, transition: Transition) -> None:
        waiting = self._waiting
        cited = self.playbook.cited(transition.decision.rationale)
        block = telling.told(transition, self.step_tokens, self._count)
        named = f"\nBullets named: {', '.join(cited)}" if cited else ""
        waiting.steps = [*waiting.steps, block + named][-self._most_waiting :]
        waiting.cited = list(dict.fromkeys([*waiting.cited, *cited]))
        waiting.since += 1
        waiting.task = transition.input.instruction
        if self.every and waiting.since >= self.every and not (transition.terminated or transition.truncated):
            await self._adapt(transition.next_text)

    async def end_episode(self, trajectory: Trajectory) -> None:
        """What is left is reflected on with the outcome when the next episode of the run begins."""
        if trajectory.transitions:
            ended = telling.outcome(trajectory)
            self._waiting.steps = [*self._waiting.steps, ended][-self._most_waiting :]

    @property
    def _most_waiting(self) -> int:
        """Steps of a reflection; of an episode that is reflected on as a whole the newest ones."""
        return 2 * self.every + 1 if self.every else 64

    # -- reflector and curator -------------------------------------------------------------------------------------

    async def _adapt(self, next_text: str = "") -> None:
        """Reflect on the steps that wait, then curate if it is time to."""
        self._waiting.since = 0
        task = clip_text(self._waiting.task.strip(), self.task_tokens, self._count) or "(not told)"
        review = await self._reflect(task, next_text)
        if review is None:
            return
        self._counts.reviews += 1
        self._last = clip_text(review.correct or review.insight, self.bullet_tokens, self._count)
        for verdict in review.bullets:
            self.playbook.tag(verdict.id, verdict.tag.strip().lower())
        waiting = self._waiting
        waiting.reviews = [*waiting.reviews, review.text()][-2 * self.curate_every :]
        waiting.steps, waiting.cited = [], []
        if len(waiting.reviews) >= self.curate_every:
            await self._curate(task)

    async def _reflect(self, task: str, next_text: str) -> Review | None:
        cited = [self.playbook[id] for id in self._waiting.cited if id in self.playbook]
        shown = cited or self.playbook.ordered()
        head = (prompts.CITED if cited else prompts.SHOWN).format(bullets=_lines(shown))
        steps = f"{telling.STEPS}\n{telling.numbered(self._waiting.steps)}"
        state = excerpt(next_text, self.step_tokens, self._count)
        now = [prompts.NOW.format(state=state)] if state else []
        review_it = prompts.REVIEW.format(words=self.answer_tokens // 2)
        parts = [*([head] if shown else []), steps, *now, review_it]
        prompt = _prompt(prompts.REFLECTOR.format(task=task), parts)
        answer = await self.services.ask(
            "reflect", prompt, self.answer_tokens, json_of(Review, repairs=self.repairs, whole=False)
        )
        review: Review | None = answer.value
        return review

    async def _curate(self, task: str) -> None:
        bullets = self.playbook.ordered()
        used = sum(self._count(b.line()) + 1 for b in bullets)
        playbook = prompts.PLAYBOOK.format(
            count=len(bullets), used=used, budget=self.playbook_tokens, bullets=_lines(bullets) or "(empty)"
        )
        reviews = prompts.REVIEWS.format(reviews="\n".join(f"- {text}" for text in self._waiting.reviews))
        deltas = prompts.DELTAS.format(most=MOST_OPERATIONS, words=self.answer_tokens // 2)
        parts = [playbook, reviews, deltas]
        prompt = _prompt(prompts.CURATOR.format(task=task, sections='" or "'.join(SECTIONS)), parts)
        parse = json_of({"operations": list[Operation]}, repairs=self.repairs, whole=False)
        answer = await self.services.ask("curate", prompt, self.answer_tokens, parse)
        if answer.value is None:
            return
        self._waiting.reviews = []
        operations = answer.value["operations"][:MOST_OPERATIONS]
        await self._refine([touched for op in operations if (touched := self._apply(op))])

    def _apply(self, operation: Operation) -> Bullet | None:
        """One delta, its text on one line and within its budget."""
        text = clip_text(" ".join(operation.content.split()), self.bullet_tokens, self._count)
        known = {b.id for b in self.playbook}
        ready = Operation(operation.type, operation.section, operation.id, operation.ids, text)
        touched = self.playbook.apply(ready, self.services.new_id)
        if touched is not None:
            self._counts.added += touched.id not in known
            self._counts.changed += touched.id in known
        return touched

    # -- grow and refine -------------------------------------------------------------------------------------------

    async def _refine(self, touched: list[Bullet]) -> None:
        """Merge what is too similar to what was touched, then keep the playbook within its budget."""
        for group in self._duplicates(touched)[:MOST_MERGES]:
            text = await self._merged(group)
            if text and self.playbook.merge([b.id for b in group], text):
                self._counts.merged += len(group) - 1
        self._counts.dropped += len(self.playbook.prune(self.playbook_tokens, self.most_bullets, self._count))
        self._reindex()

    def _duplicates(self, touched: list[Bullet]) -> list[list[Bullet]]:
        """Groups of bullets that are `dedupe` similar, each with one of those touched in it."""
        self._reindex()
        if self._index is None:
            return []
        numbers = {b.number: b for b in self.playbook}
        graph: Graph[int] = Graph()
        for bullet in touched:
            if bullet.number in numbers:
                for other, _ in self._index.similar(bullet.number, len(numbers), least=self.dedupe - 1e-6):
                    graph.connect(bullet.number, other)
        return [[numbers[n] for n in sorted(group)] for group in graph.components()]

    async def _merged(self, group: list[Bullet]) -> str:
        if self.merge == "best":
            return max(group, key=lambda b: (b.balance, b.number)).text
        answer = await self.services.ask("merge", prompts.MERGE.format(bullets=_lines(group)), 2 * self.bullet_tokens)
        if answer.problem:
            return ""
        return clip_text(" ".join(str(answer.value).split()), self.bullet_tokens, self._count)

    def _reindex(self) -> None:
        """The index as the playbook is; what did not change is not embedded again."""
        if self._index is None:
            return
        numbers = {b.number: b for b in self.playbook}
        for number in [n for n in self._index if n not in numbers]:
            self._index.remove(number)
        for number, bullet in numbers.items():
            self._index.put(number, bullet.text)

    def _count(self, text: str) -> int:
        return self.services.llm.count_tokens(text)

    # -- state -----------------------------------------------------------------------------------------------------

    def metrics(self) -> dict[str, int]:
        """Bullets, and what happened to them so far."""
        return {"bullets": len(self.playbook), **vars(self._counts)}

    def snapshot(self) -> bytes:
        order = list(self._index) if self._index is not None else []
        return dump_state([self.playbook.state(), order, self._last, vars(self._waiting), vars(self._counts)])

    def restore(self, blob: bytes) -> None:
        bullets, order, self._last, waiting, counts = load_state(blob)
        self.playbook = Playbook.load(bullets)
        self._waiting, self._counts = Waiting(**waiting), Counts(**counts)
        if self._index is not None:
            texts = {b.number: b.text for b in self.playbook}
            self._index.load([(number, texts[number]) for number in order])


def _lines(bullets: list[Bullet]) -> str:
    return "\n".join(b.line() for b in bullets)


def _prompt(role: str, parts: list[str]) -> tuple[Message, ...]:
    return system(role), user("\n\n".join(parts))
