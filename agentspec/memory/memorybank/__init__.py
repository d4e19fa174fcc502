"""MemoryBank (Zhong et al., 2024): raw steps, summaries and insights that fade unless they are recalled.

The paper keeps every turn of a dialogue, writes a summary and a portrait of the user for each day and one of all days,
finds what fits by dense retrieval, and forgets along Ebbinghaus' curve: after time t an entry of strength S is still
there with probability R = e^(-t/S), and each recall adds 1 to S and starts t anew.

AgentSpec's form has three kinds of entry: raw steps, `[Trajectory Summary]` and `[Environment Insight]` (thresholds,
what to avoid, what to do next). A *day* is a stretch of `every` steps. When it is over, summary and insights are
written (two calls in one batch); after `overview_every` days a third call rewrites the overview of all days. Then comes
the forgetting, with t in steps over `time_unit`. The authors' published code has e^(-t*S/5), which forgets strong
entries *faster*; here it is e^(-t/(time_unit*S)). A pass draws for the time since the pass before it, so that what is
left after t is R(t) however many passes lie between.

Which row of the paper's tables: `writer: llm` is its ReAct + MemoryBank (the prompt traces show insights that a model
wrote); `writer: template` writes summaries and warnings by rule, without a model, as the method is marked on the
project's site. Cost per step: none to retrieve; 2 calls per `every` steps, and 1 per `every * overview_every`.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.memory.memorybank.entries import Conclusions, Entry, avoid_by_rule, by_rule, retention
from agentspec.memory.memorybank.prompts import CONCLUDE, HEAD, OVERVIEW, SUMMARISE
from agentspec.memory.parts.steps import (
    brief,
    distinct,
    first_held,
    goal_of,
    newest_within,
    step_name,
    step_text,
    written,
)
from agentspec.memory.parts.telling import outcome, when
from agentspec.parameters import at_least, one_of, settings
from agentspec.protocols import Services
from agentspec.registry import SpecError
from agentspec.retrieval import VectorIndex
from agentspec.state import dump_state, keyed, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, RecallItem, Task, Transition

KINDS = ("insight", "summary", "raw")
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"every": 10, "overview_every": 5, "answer_tokens": 256, "steps_tokens": 1600},
    "rl": {"every": 16, "overview_every": 0, "answer_tokens": 128, "steps_tokens": 768},
}
NEXT_EPISODE = "[Plan for the next episode]"


class MemoryBank:
    """Three granularities of memory with a forgetting curve.

    Args:
        preset: `paper` (a day of 10 steps) or `rl` (a day of 16 steps, shorter answers, no overview).
        writer: `llm`, or `template` for summaries and warnings by rule.
        every: steps of a day, after which memory is written.
        overview_every: days between overviews (0: none); needs `writer: llm`.
        insights: insights recalled in a step; with `summaries` and `raw` the paper's 6 entries.
        summaries: summaries recalled in a step.
        raw: raw steps recalled in a step, of those that the prompt does not show anyway.
        recent: newest steps that are always shown where no conversation shows them.
        forget: when a day is over: `sample` (an entry stays with probability R, the paper's), `threshold` (it stays
            if R is at least `least`) or `never`.
        least: threshold of retention.
        time_unit: steps after which an entry of strength 1 has faded to 1/e.
        duplicate: cosine similarity from which on an insight strengthens the one that is there, and adds nothing.
        max_entries: most entries; what is retained least goes first.
        state_tokens: most tokens of the state kept with a raw step.
        answer_tokens: most tokens of each answer, and of an entry.
        steps_tokens: most tokens of steps in a prompt.
    """

    declaration = Declaration(
        "steps, summaries and insights that fade unless they are recalled",
        calls=CallProfile(store=(0, 4), episode=(0, 4)),
        rl=CallProfile(store=(0, 3), episode=(0, 3)),
        purposes={
            "summary": Purpose("store", "Took order 3 at 12:04; it is in the bag, 250m from the customer."),
            "insight": Purpose(
                "store", '{"insights": ["A minute costs 1 % of energy."], "avoid": [], "next": ["ADD() first"]}'
            ),
            "overview": Purpose("store", "Energy falls by 1 % a minute. Two days went well."),
        },
        needs=("embedder",),
        small=(
            {"every": 3, "overview_every": 2, "max_entries": 10, "time_unit": 4},
            {"every": 2, "writer": "template", "forget": "threshold", "time_unit": 4},
        ),
        aliases=("memory_bank",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        writer: str = "llm",
        every: int | None = None,
        overview_every: int | None = None,
        insights: int = 2,
        summaries: int = 1,
        raw: int = 3,
        recent: int = 3,
        forget: str = "sample",
        least: float = 0.3,
        time_unit: float = 100.0,
        duplicate: float = 0.9,
        max_entries: int = 500,
        state_tokens: int = 80,
        answer_tokens: int | None = None,
        steps_tokens: int | None = None,
    ) -> None:
        given = {"every": every, "overview_every": overview_every, "answer_tokens": answer_tokens}
        chosen = settings("memorybank", PRESETS, preset, {**given, "steps_tokens": steps_tokens})
        self.every, self.overview_every = chosen["every"], chosen["overview_every"]
        self.answer_tokens, self.steps_tokens = chosen["answer_tokens"], chosen["steps_tokens"]
        at_least("memorybank", 1, every=self.every, max_entries=max_entries, answer_tokens=self.answer_tokens)
        at_least("memorybank", 0, insights=insights, summaries=summaries, raw=raw, recent=recent)
        one_of("memorybank", writer=(writer, ("llm", "template")), forget=(forget, ("sample", "threshold", "never")))
        if time_unit <= 0:
            raise SpecError(f"memorybank: time_unit must be above 0 (steps), got {time_unit}")
        self.services = services
        self.writer, self.forget, self.least, self.time_unit = writer, forget, least, float(time_unit)
        self.quota = {"insight": insights, "summary": summaries, "raw": raw}
        self.recent, self.duplicate, self.max_entries = recent, duplicate, max_entries
        self.state_tokens = state_tokens
        self.entries: dict[int, Entry] = {}
        self.overview = ""
        self._merged: list[int] = []  # summaries and insights that are not in the overview yet
        self._plan = ""
        self._days, self._last_pass = 0, 0
        self._seed = services.rng.getrandbits(32)  # of the draws: a restored memory forgets as it would have
        self._day_began, self._held_from = 0, 0  # steps of this episode
        self._task = ""
        self._forgotten = 0
        self._index = self._indices()

    def begin_episode(self, task: Task) -> None:
        self._day_began, self._held_from = 0, 0
        if not self._plan.startswith(NEXT_EPISODE):
            self._plan = ""

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """Overview, insights, summaries and steps that fit the observation, the newest steps; recall strengthens."""
        now = self.services.time()
        found = self._found(input.text)
        found = sorted(found, key=lambda hit: -hit[1])[:k] if k is not None else found
        for key, _ in found:
            entry = self.entries[key]
            self.entries[key] = replace(entry, strength=entry.strength + 1, since=now.total)
        items = [RecallItem(f"[Overview] {self.overview}", 1.0, "summary", priority=3.0)] if self.overview else []
        order = sorted(found, key=lambda hit: (KINDS.index(self.entries[hit[0]].kind), hit[0]))
        items += [self._item(key, score) for key, score in order]
        if self._plan:
            items.append(RecallItem(self._plan, 1.0, "insight", priority=2.5))
        if self.services.context.layout == "snapshot":
            newest = self._steps(now.episode, max(0, now.step - self.recent))
            count = self.services.llm.count_tokens
            items += [RecallItem(brief(self._named(e), count), 1.0, "step", priority=4.0 + e.step) for e in newest]
        return Recall(tuple(items))

    async def store(self, transition: Transition) -> None:
        text = step_text(transition, self.state_tokens, self.services.llm.count_tokens)
        self._add("raw", text, transition.step)
        self._held_from = first_held(self.services, transition.step)
        self._task = goal_of(transition.input.instruction, self.services.llm.count_tokens)
        ended = transition.terminated or transition.truncated
        if not ended and transition.step + 1 - self._day_began >= self.every:
            await self._close_day(transition.step + 1)

    async def end_episode(self, trajectory: Trajectory) -> None:
        steps = len(trajectory.transitions)
        if self.services.carried and steps > self._day_began:
            await self._close_day(steps, outcome(trajectory))
        elif self.services.carried and steps:  # its last day has been summed up: the result stands by itself
            self._merged.append(self._add("summary", outcome(trajectory), steps - 1))

    async def _close_day(self, step: int, ending: str = "") -> None:
        """Write what the day was, forget what has faded, and begin the next one."""
        day = self._steps(self.services.time().episode, self._day_began)
        if self.writer == "template":
            summary, found = by_rule(day, ending), Conclusions([], avoid_by_rule(day))
        else:
            summary, found = await self._ask(day, ending)
        if summary:
            self._merged.append(self._add("summary", summary, step - 1))
        for text in (*found.insights[:3], *(f"Avoid: {a}" for a in found.avoid[:2])):
            self._learn(text, step - 1)
        if found.next:
            label = NEXT_EPISODE if ending else f"[Plan after step {step}]"
            self._plan = f"{label} {'; '.join(self._clip(text) for text in found.next[:3])}"
        self._days += 1
        self._day_began = step
        if self.writer == "llm" and self.overview_every and self._days % self.overview_every == 0:
            await self._rewrite_overview()
        self._fade()

    async def _ask(self, day: Sequence[Entry], ending: str) -> tuple[str, Conclusions]:
        count = self.services.llm.count_tokens
        steps = newest_within([self._named(e) for e in day], self.steps_tokens, count)
        head = HEAD.format(task=self._task, steps="\n".join(steps + ([ending] if ending else [])))
        known = [e.text for e in self.entries.values() if e.kind == "insight"]
        known = newest_within([f"- {text}" for text in known], self.answer_tokens, count, "ones")
        prompts = (
            head + SUMMARISE.format(words=self.answer_tokens // 3),
            head
            + CONCLUDE.format(
                known="\n".join(known) or "(none)",
                words=self.answer_tokens // 2,
                next="in the next episode" if ending else "next",
            ),
        )
        summary, found = await asyncio.gather(
            self.services.ask("summary", prompts[0], self.answer_tokens),
            self.services.ask("insight", prompts[1], self.answer_tokens, json_of(Conclusions, whole=False)),
        )
        return written(summary, self.answer_tokens, count), found.value or Conclusions([])

    async def _rewrite_overview(self) -> None:
        notes = [f"- {self.entries[key].text}" for key in self._merged if key in self.entries]
        if not notes:
            return
        count = self.services.llm.count_tokens
        prompt = OVERVIEW.format(
            words=self.answer_tokens // 2,
            overview=self.overview or "(none)",
            notes="\n".join(newest_within(notes, self.steps_tokens, count, "notes")),
        )
        answer = await self.services.ask("overview", prompt, self.answer_tokens)
        text = written(answer, self.answer_tokens, count)
        if text:
            self.overview, self._merged = text, []

    def _add(self, kind: str, text: str, step: int) -> int:
        """Store an entry; beyond `max_entries` the one that is retained least goes."""
        now, key = self.services.time(), self.services.new_id()
        self.entries[key] = Entry(kind, text, now.episode, step, now.total)
        if kind in self._index:
            self._index[kind].put(key, text)
        if len(self.entries) > self.max_entries:
            self._drop(min((k for k in self.entries if k != key), key=lambda k: (self._retained(k), k), default=key))
        return key

    def _learn(self, text: str, step: int) -> None:
        """An insight; what is known already becomes stronger."""
        text = self._clip(" ".join(text.split()))
        if not text:
            return
        near = self._index["insight"].search(text, 1, least=self.duplicate) if self._index else []
        same = [k for k, _ in near] or [k for k, e in self.entries.items() if e.kind == "insight" and e.text == text]
        if same:
            entry = self.entries[same[0]]
            self.entries[same[0]] = replace(entry, strength=entry.strength + 1, since=self.services.time().total)
        else:
            self._merged.append(self._add("insight", text, step))

    def _fade(self) -> None:
        """Ebbinghaus: draw, or compare with the threshold; what belongs to the running day is not touched."""
        now, draw = self.services.time(), random.Random(f"{self._seed}/{self._days}")
        for key, entry in list(self.entries.items()):
            if self.forget == "sample":
                elapsed = now.total - max(entry.since, self._last_pass)
                stays = draw.random() < retention(elapsed, entry.strength, self.time_unit)
            else:
                stays = self.forget == "never" or self._retained(key) >= self.least
            if not stays:
                self._drop(key)
        self._last_pass = now.total

    def _retained(self, key: int) -> float:
        entry = self.entries[key]
        return retention(self.services.time().total - entry.since, entry.strength, self.time_unit)

    def _drop(self, key: int) -> None:
        kind = self.entries.pop(key).kind
        if kind in self._index:
            self._index[kind].remove(key)
        self._merged = [k for k in self._merged if k != key]
        self._forgotten += 1

    def _found(self, query: str) -> list[tuple[int, float]]:
        """The nearest entries of each kind, up to its quota; no step that the prompt shows anyway."""
        now = self.services.time()
        if self.services.context.layout == "conversation":
            shown_from = self._held_from
        else:
            shown_from = max(0, now.step - self.recent)
        found: list[tuple[int, float]] = []
        for kind, index in self._index.items():
            hidden = max(0, now.step - shown_from) if kind == "raw" else 0
            hits = index.search(query, 2 * self.quota[kind] + hidden) if self.quota[kind] else []
            if kind == "raw":
                hits = [h for h in hits if not self._is_shown(self.entries[h[0]], now.episode, shown_from)]
                hits = distinct(hits, lambda key: self.entries[key].text)
            found += hits[: self.quota[kind]]
        return found

    @staticmethod
    def _is_shown(entry: Entry, episode: int, first: int) -> bool:
        return entry.episode == episode and entry.step >= first

    def _steps(self, episode: int, first: int) -> list[Entry]:
        """The raw steps of an episode from step `first` on."""
        steps: list[Entry] = []
        for entry in reversed(self.entries.values()):
            if entry.episode != episode or (entry.kind == "raw" and entry.step < first):
                break
            if entry.kind == "raw":
                steps.append(entry)
        return steps[::-1]

    def _item(self, key: int, score: float) -> RecallItem:
        entry = self.entries[key]
        over = when(entry.episode, self.services.time().episode)
        label = {"summary": f"[Trajectory Summary] {over}", "insight": "[Environment Insight] "}.get(entry.kind, "")
        text = self._named(entry) if entry.kind == "raw" else f"{label}{entry.text}"
        kind = "episodic" if entry.kind == "raw" else entry.kind
        return RecallItem(
            text, score, kind, str(key), priority=score + {"raw": 0, "summary": 1, "insight": 1}[entry.kind]
        )

    def _named(self, entry: Entry) -> str:
        return f"{step_name(entry.episode, entry.step, self.services.time())}: {entry.text}"

    def _clip(self, text: str) -> str:
        return clip_text(text, self.answer_tokens // 2, self.services.llm.count_tokens)

    def _indices(self) -> dict[str, VectorIndex]:
        embedder = self.services.embedder
        return {kind: VectorIndex(embedder) for kind in KINDS} if embedder is not None else {}

    def metrics(self) -> Mapping[str, Any]:
        """Entries of each kind, entries forgotten so far (by the curve or the cap), and their mean strength."""
        kinds = [entry.kind for entry in self.entries.values()]
        strength = sum(e.strength for e in self.entries.values()) / max(1, len(kinds))
        counts = {f"entries/{kind}": kinds.count(kind) for kind in KINDS}
        return {**counts, "forgotten": self._forgotten, "mean_strength": strength}

    def snapshot(self) -> bytes:
        times = [self._days, self._last_pass, self._day_began, self._held_from, self._forgotten, self._seed]
        return dump_state([keyed(self.entries), self.overview, self._merged, self._plan, self._task, times])

    def restore(self, blob: bytes) -> None:
        entries, self.overview, self._merged, self._plan, self._task, times = load_state(blob)
        self._days, self._last_pass, self._day_began, self._held_from, self._forgotten, self._seed = times
        self.entries = {key: Entry(*values) for key, values in entries}
        for kind, index in self._index.items():
            index.load([(key, entry.text) for key, entry in self.entries.items() if entry.kind == kind])
