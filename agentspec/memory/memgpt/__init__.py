"""MemGPT (Packer et al., 2023; now Letta): the model moves its own memory between a small context and large stores.

Main context: *core memory*, blocks of bounded size that are always shown (`task`, `strategy`), and a queue of messages
whose head is a recursive summary. Outside: *recall storage* (all messages, searched by words) and *archival storage*
(what the model put there, searched by meaning). The model calls functions: `core_append`, `core_replace`,
`archive_insert`, `archive_search`, `recall_search` (pages of 5); with `heartbeat` it asks to be called again, to see
what they gave. The queue manager warns at 0.75 of the capacity; beyond the capacity it evicts the oldest messages down
to 0.75, keeps at least the last 3, and has them summarised together with the summary before.

AgentSpec's form: after every `every` steps, and when the queue warns, the model is asked for function calls; with a
heartbeat once more. What a search found is shown until the next one. In a `conversation` the queue is the conversation
(evicted steps leave it, and the summary stands in front of it); in a `snapshot` it is a list of steps that is shown
with the rest. An error (a block that is full, an unknown function) goes back to the model as text.

Cost per step: none to retrieve; at most 2 calls per `every` steps (1 to 2 after every step in the paper's preset) and
1 per eviction.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.memory.memgpt.prompts import CARRY, EDIT, SUMMARISE, WARNING, FunctionCall, FunctionCalls
from agentspec.memory.parts.steps import (
    brief,
    distinct,
    first_told,
    goal_of,
    newest_within,
    step_name,
    step_text,
    written,
)
from agentspec.memory.parts.telling import outcome
from agentspec.parameters import at_least, settings
from agentspec.protocols import Services
from agentspec.registry import SpecError
from agentspec.retrieval import Lexical, VectorIndex
from agentspec.state import Record, dump_state, keyed, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, RecallItem, Task, Transition

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"every": 1, "block_chars": 2000, "answer_tokens": 320},
    "rl": {"every": 8, "block_chars": 600, "answer_tokens": 256},
}
BLOCKS = ("task", "strategy")
PAGE = 5
SEARCHES = ("archive_search", "recall_search")
WARN, DOWN_TO, KEEP = 0.75, 0.75, 3
MOST_CALLS = 4
CHARS_PER_TOKEN, LEAST_CHARS = 3, 60


@dataclass(frozen=True)
class Message(Record):
    """A step as it stands in recall storage."""

    text: str
    episode: int
    step: int


class MemGPT:
    """Core blocks, a queue, recall and archival storage, moved by the model's function calls.

    Args:
        preset: `paper` (asked after every step, blocks of 2,000 characters) or `rl` (every 8 steps, 600 characters).
        every: steps between requests for function calls; a queue under pressure asks too, once per eviction.
        block_chars: most characters of a core block, and no more than what may be recalled in a step has room for (for
            2,000 set `recall_tokens: 1400`); a call that would exceed it is refused with an error.
        queue_tokens: capacity of the queue (0: of a conversation 0.8 of the model's window, otherwise half of what
            may be recalled in a step).
        max_recall: most steps in recall storage; the oldest go first.
        max_archive: most archival entries; the oldest go first.
        state_tokens: most tokens of the state kept with a step.
        answer_tokens: most tokens of an answer, of a summary and of an archival entry.
        steps_tokens: most tokens of steps in a prompt.
    """

    declaration = Declaration(
        "core blocks, queue and searchable stores that the model manages by function calls",
        calls=CallProfile(store=(0, 5), episode=(0, 4)),
        rl=CallProfile(store=(0, 5), episode=(0, 4)),
        purposes={
            "edit": Purpose(
                "store",
                '{"calls": [{"function": "core_append", "block": "task", "text": "Get 1000."}, '
                '{"function": "archive_insert", "text": "ADD adds"}, {"function": "archive_search", "query": "task"}, '
                '{"function": "recall_search", "query": "goal"}], "heartbeat": true}',
            ),
            "summary": Purpose("store", "The number grew from 3. The target is far."),
        },
        needs=("embedder",),
        small=(
            {"every": 3, "queue_tokens": 420, "block_chars": 60, "max_archive": 2},
            {"every": 20, "queue_tokens": 300, "max_recall": 5},
        ),
        aliases=("letta",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        every: int | None = None,
        block_chars: int | None = None,
        queue_tokens: int = 0,
        max_recall: int = 2000,
        max_archive: int = 500,
        state_tokens: int = 80,
        answer_tokens: int | None = None,
        steps_tokens: int = 768,
    ) -> None:
        given = {"every": every, "block_chars": block_chars, "answer_tokens": answer_tokens}
        chosen = settings("memgpt", PRESETS, preset, given)
        self.every, self.block_chars = chosen["every"], chosen["block_chars"]
        self.answer_tokens = chosen["answer_tokens"]
        at_least("memgpt", 1, every=self.every, block_chars=self.block_chars, max_archive=max_archive)
        at_least("memgpt", 0, queue_tokens=queue_tokens)
        if max_recall <= KEEP:
            raise SpecError(f"memgpt: max_recall must be above {KEEP} (what an eviction keeps), got {max_recall}")
        self.services = services
        self.queue_tokens, self.steps_tokens, self.state_tokens = queue_tokens, steps_tokens, state_tokens
        self.max_recall, self.max_archive = max_recall, max_archive
        self.blocks = dict.fromkeys(BLOCKS, "")
        self.summary = ""
        self.recall: dict[int, Message] = {}
        self.archive: dict[int, str] = {}
        self._found: list[str] = []
        self._asked, self._queued, self._warned = 0, 0, False  # steps of this episode
        self._task = ""
        self._old_task = False  # the block `task` was written in an earlier episode
        self._counts = {"evictions": 0, "function_errors": 0}
        self._build_indices()

    @property
    def capacity(self) -> int:
        """Tokens that the queue may hold (0: no limit)."""
        context = self.services.context
        if self.queue_tokens:
            return self.queue_tokens
        return int(0.8 * context.window) if context.layout == "conversation" else context.recall_tokens // 2

    @property
    def room(self) -> int:
        """Characters that a block may hold: what is written there is always shown, whole."""
        context = self.services.context
        queue = min(self.capacity, context.recall_tokens // 2) if context.layout == "snapshot" else 0
        tokens = context.recall_tokens - queue
        return min(self.block_chars, max(LEAST_CHARS, CHARS_PER_TOKEN * tokens // len(BLOCKS)))

    def begin_episode(self, task: Task) -> None:
        self._asked, self._queued, self._warned = 0, 0, False
        self._found, self.summary = [], ""
        self._old_task = bool(self.blocks["task"])

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """Core blocks, what the last search found; where no conversation shows them, summary and queue."""
        items = [
            RecallItem(f"[{self._label(name)}] {text}", kind="core", source=name, priority=math.inf)
            for name, text in self.blocks.items()
            if text
        ]
        first = first_told(self.services)
        told = {self._named(m) for m in self._queue() if m.step >= first}
        items += [RecallItem(text, source="search", priority=1.0) for text in self._found if text not in told]
        if self.services.context.layout == "snapshot":
            if self.summary:
                items.append(RecallItem(CARRY.format(summary=self.summary), kind="summary", priority=3.0))
            count = self.services.llm.count_tokens
            queue = [(m.step, brief(self._named(m), count)) for m in self._queue()]
            items += [RecallItem(text, kind="step", priority=5.0 + step) for step, text in queue]
        return Recall(tuple(items[:k] if k is not None else items))

    async def store(self, transition: Transition) -> None:
        count = self.services.llm.count_tokens
        self._record(step_text(transition, self.state_tokens, count), transition.step)
        self._task = goal_of(transition.input.instruction, count)
        if transition.terminated or transition.truncated:
            return
        share = self._used() / self.capacity if self.capacity else 0.0
        warning = WARNING.format(share=share) if share >= WARN and not self._warned else ""
        if warning or transition.step + 1 - self._asked >= self.every:
            self._warned = self._warned or bool(warning)
            await self._edit(transition.step + 1, warning)
        if share > 1.0:
            await self._evict()

    async def end_episode(self, trajectory: Trajectory) -> None:
        steps = len(trajectory.transitions)
        if self.services.carried and steps > self._asked:
            await self._edit(steps, f"\n\n{outcome(trajectory)}")
        elif self.services.carried and steps:  # nothing is left to ask about
            text = f"Episode {self.services.time().episode + 1}: {outcome(trajectory)}"
            self._archive_insert(FunctionCall("archive_insert", text=text))

    async def _edit(self, step: int, warning: str) -> None:
        """Ask for function calls; with a heartbeat once more, with what the first ones gave."""
        since, self._asked = self._asked, step
        results: list[str] = []
        searched = False
        for _ in range(2):
            answer = await self.services.ask(
                "edit", self._prompt(since, warning, results), self.answer_tokens, json_of(FunctionCalls, whole=False)
            )
            if answer.value is None:
                return
            calls = answer.value.calls[:MOST_CALLS]
            if not searched and any(call.function in SEARCHES for call in calls):
                self._found, searched = [], True
            results = [self._call(call) for call in calls]
            failed = any(r.startswith("Error") for r in results)
            if not (answer.value.heartbeat or failed) or not results:
                return

    def _prompt(self, since: int, warning: str, results: list[str]) -> str:
        count = self.services.llm.count_tokens
        here = self.services.time().episode
        ours = itertools.takewhile(lambda m: m.episode == here and m.step >= since, reversed(self.recall.values()))
        steps = [self._named(m) for m in ours][::-1]
        told = "\n\nResults of your calls:\n" + "\n".join(results) if results else ""
        return EDIT.format(
            chars=self.room,
            task=self._task,
            blocks="\n".join(
                f"{self._label(n)} ({len(t)} of {self.room}): {t or '(empty)'}" for n, t in self.blocks.items()
            ),
            archived=len(self.archive),
            recorded=len(self.recall),
            steps="\n".join(newest_within(steps, self.steps_tokens, count)),
            warning=warning,
            results=clip_text(told, self.steps_tokens, count),
        )

    def _call(self, call: FunctionCall) -> str:
        """Carry out a function call; what it gave, or an error in words for the model."""
        functions = {
            "core_append": self._core_append,
            "core_replace": self._core_replace,
            "archive_insert": self._archive_insert,
            "archive_search": self._archive_search,
            "recall_search": self._recall_search,
        }
        function = functions.get(call.function)
        if function is None:
            result = f"Error: there is no function {call.function[:40]!r}; expected one of {', '.join(functions)}"
        else:
            result = function(call)
        self._counts["function_errors"] += result.startswith("Error")
        return f"{call.function[:40]}: {result}" if not result.startswith("Error") else result

    def _core_append(self, call: FunctionCall) -> str:
        before = self.blocks.get(call.block, "")
        if call.text.strip() and call.text.strip() in before:
            return "it says so already"
        return self._set_block(call.block, "\n".join(filter(None, (before, call.text.strip()))))

    def _core_replace(self, call: FunctionCall) -> str:
        text = self.blocks.get(call.block, "")
        if call.block in self.blocks and (not call.old or call.old not in text):
            return f"Error: block {call.block} does not contain {call.old[:60]!r}; give a part of it word for word"
        return self._set_block(call.block, text.replace(call.old, call.new, 1).strip())

    def _set_block(self, block: str, text: str) -> str:
        if block not in self.blocks:
            return f"Error: there is no block {block[:40]!r}; expected one of {', '.join(self.blocks)}"
        if len(text) > max(self.room, len(self.blocks[block]) - 1):
            full = f"Error: block {block} would hold {len(text)} of {self.room} characters"
            return f"{full}; shorten it with core_replace, or use archive_insert"
        self.blocks[block] = text
        self._old_task = self._old_task and block != "task"
        return "done"

    def _archive_insert(self, call: FunctionCall) -> str:
        text = clip_text(" ".join(call.text.split()), self.answer_tokens, self.services.llm.count_tokens)
        if not text:
            return "Error: archive_insert needs a text"
        if text in self.archive.values():
            return "it is there already"
        key = self.services.new_id()
        self.archive[key] = text
        if self._vectors is not None:
            self._vectors.put(key, text)
        while len(self.archive) > self.max_archive:
            oldest = next(iter(self.archive))
            del self.archive[oldest]
            if self._vectors is not None:
                self._vectors.remove(oldest)
        return "done"

    def _archive_search(self, call: FunctionCall) -> str:
        page = max(0, call.page)
        hits = self._vectors.search(call.query, PAGE * (page + 1)) if self._vectors is not None else []
        return self._page([self.archive[key] for key, _ in hits], page)

    def _recall_search(self, call: FunctionCall) -> str:
        page = max(0, call.page)
        hits = self._words.search(call.query, 2 * PAGE * (page + 1))
        hits = distinct(hits, lambda key: self.recall[key].text)
        return self._page([self._named(self.recall[key]) for key, _ in hits], page)

    def _page(self, texts: list[str], page: int) -> str:
        """One page of results, which the agent is shown too."""
        shown = texts[PAGE * page : PAGE * (page + 1)]
        self._found += [text for text in shown if text not in self._found]
        return f"page {page}: " + ("\n".join(shown) if shown else "nothing found")

    def _record(self, text: str, step: int) -> None:
        key = self.services.new_id()
        self.recall[key] = Message(text, self.services.time().episode, step)
        self._words.put(key, text)
        while len(self.recall) > self.max_recall:
            oldest = next(iter(self.recall))
            del self.recall[oldest]
            self._words.remove(oldest)

    def _queue(self) -> list[Message]:
        """The messages of this episode that have not been evicted."""
        episode, queue = self.services.time().episode, list[Message]()
        for message in reversed(self.recall.values()):
            if message.episode != episode or message.step < self._queued:
                break
            queue.append(message)
        return queue[::-1]

    def _used(self) -> int:
        if self.services.context.layout == "conversation":
            return self.services.context.tokens()
        return self._size(self._queue())

    def _size(self, queue: list[Message]) -> int:
        count = self.services.llm.count_tokens
        return sum(count(brief(self._named(m), count)) + 1 for m in queue)

    async def _evict(self) -> None:
        """Let the oldest messages leave the queue, down to 0.75 of it; a summary of them and the one before stays."""
        count, context = self.services.llm.count_tokens, self.services.context
        queue, target = self._queue(), DOWN_TO * self.capacity
        keep = min(len(queue), context.steps) if context.layout == "conversation" else len(queue)
        while keep > KEEP and self._left(keep, queue) > target:
            keep -= 1
        leaving = queue[: len(queue) - keep]
        if not leaving:
            return
        prompt = SUMMARISE.format(
            words=self.answer_tokens // 2,
            summary=self.summary or "(none)",
            messages="\n".join(newest_within([self._named(m) for m in leaving], 2 * self.steps_tokens, count)),
        )
        answer = await self.services.ask("summary", prompt, self.answer_tokens)
        self.summary = written(answer, self.answer_tokens, count) or self.summary
        if context.layout == "conversation":
            context.evict(keep, CARRY.format(summary=self.summary) if self.summary else "")
        self._queued = queue[len(queue) - keep].step
        self._warned = False
        self._counts["evictions"] += 1

    def _left(self, keep: int, queue: list[Message]) -> int:
        """Tokens of the queue with its newest `keep` messages."""
        context = self.services.context
        if context.layout == "snapshot":
            return self._size(queue[-keep:])
        count = self.services.llm.count_tokens
        return context.tokens() - sum(count(m.text) for m in context.older(keep))

    def _label(self, block: str) -> str:
        return "task, as of an earlier episode" if block == "task" and self._old_task else block

    def _named(self, message: Message) -> str:
        return f"{step_name(message.episode, message.step, self.services.time())}: {message.text}"

    def describe(self) -> str:
        """Blocks, archive and recall storage as one text."""
        core = [f"[{name}] {text}" for name, text in self.blocks.items()]
        archive = [f"- {text}" for text in self.archive.values()]
        recorded = [f"- episode {m.episode + 1}, step {m.step + 1}: {m.text}" for m in self.recall.values()]
        return "\n".join(["Core memory", *core, "Archive", *archive, "Recall storage", *recorded])

    def metrics(self) -> Mapping[str, Any]:
        """Sizes of the stores; evictions, and function calls that were refused, so far."""
        chars = sum(map(len, self.blocks.values()))
        return {"core_chars": chars, "archive": len(self.archive), "recall": len(self.recall), **self._counts}

    def snapshot(self) -> bytes:
        here = [self._asked, self._queued, self._warned, self._task, self._found, self._old_task]
        return dump_state(
            [self.blocks, self.summary, keyed(self.recall), list(self.archive.items()), here, self._counts]
        )

    def restore(self, blob: bytes) -> None:
        self.blocks, self.summary, recorded, archive, here, self._counts = load_state(blob)
        self.recall = {key: Message(*values) for key, values in recorded}
        self.archive = {key: text for key, text in archive}
        self._asked, self._queued, self._warned, self._task, self._found, self._old_task = here
        self._build_indices()

    def _build_indices(self) -> None:
        embedder = self.services.embedder
        self._words = Lexical()
        for key, message in self.recall.items():
            self._words.put(key, message.text)
        self._vectors = VectorIndex(embedder) if embedder is not None else None
        if self._vectors is not None:
            self._vectors.load(list(self.archive.items()))
