"""Dynamic Cheatsheet (Suzgun et al., 2025, arXiv 2504.07952): one sheet of notes that a curator rewrites, whole.

The curator is the same model. It reads the sheet as it is and what happened since, judges for itself what worked, and
writes the *whole* sheet anew: what it does not copy is lost. The sheet stands verbatim in the next prompts, and under
`scope: run` in those of later episodes. Two variants, as in the paper:

- `cu` (cumulative, the default): every `every` steps the curator rewrites the sheet from the steps since.
- `rs` (retrieval-synthesis): every `every` steps, *before* the action, the `top` past steps most similar to the present
  state are looked up by embedding, and the curator writes the sheet for the present state from the sheet and these,
  the least similar first, each with its similarity. Steps of earlier episodes come before those of the present one,
  since neighbouring states would fill every place. Where `every` is above 1 the curator also reads the steps since the
  last rewrite, which would pass unseen otherwise; where it is 1 the agent reads the newest step itself.

AgentSpec's form: a step takes the place of the paper's problem. The steps left at an episode's end are curated with its
outcome when the next episode of the run begins, so that nothing is asked that no action can profit from, and what is
asked is paid for by the episode that reads it. The environment's feedback stands in the steps; the paper's curator has
none and judges answers alone. The sheet's room is `sheet_tokens` or the spec's `recall_tokens`, whichever is less, so
that what is written is what is shown: for the paper's 2,000 words set `recall_tokens: 3000`.

An answer without its tags, empty or cut off leaves the sheet as it is (an unfinished rewrite would lose entries); the
steps wait for the next turn. Presets: `paper` (every step; one call a step, the paper's row *ReAct + DC*) and `rl`
(every 6 steps, a short sheet, and the bare answer is the sheet, since small models do not write tags).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, system, user
from agentspec.memory.dynamic_cheatsheet import prompts
from agentspec.memory.parts import telling
from agentspec.parameters import at_least, one_of, settings
from agentspec.protocols import Services
from agentspec.retrieval import VectorIndex, top_rows
from agentspec.state import Record, dump_state, keyed, load_state
from agentspec.structured import ParseError, Parser
from agentspec.tokens import clip_text, excerpt
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Experience, Recall, RecallItem, Task, Transition
from agentspec.visible import visible

PRESETS = {
    "paper": {"every": 1, "top": 3, "sheet_tokens": 2048, "step_tokens": 768, "task_tokens": 1024, "tags": True},
    "rl": {"every": 6, "top": 2, "sheet_tokens": 256, "step_tokens": 96, "task_tokens": 256, "tags": False},
}

HEADER = "Cheat sheet:"
_TAGS = re.compile(r"<cheatsheet>(.*?)</cheatsheet>", re.DOTALL | re.IGNORECASE)
_TAG = re.compile(r"</?cheatsheet>", re.IGNORECASE)
_LEAD = re.compile(r"\A[^\n]*:\s*\n+(?=\s*(?:[-*] |```))")  # "Here is the new sheet:"
_FENCE = re.compile(r"\A\s*```\w*\n|\n?```\s*\Z")


def read_sheet(text: str, tags: bool = True) -> str:
    """The sheet in an answer: between the last pair of tags, or (`tags=False`) the whole answer if it has none.

    Raises:
        ParseError: no complete pair of tags, or nothing in it.
    """
    text = visible(text)[0]
    found = _TAGS.findall(text)
    if not found and (tags or _TAG.search(text)):
        raise ParseError("there is no complete <cheatsheet>...</cheatsheet> in it")
    sheet = _FENCE.sub("", found[-1] if found else _LEAD.sub("", text.strip())).strip()
    if not sheet:
        raise ParseError("the sheet is empty")
    return str(sheet)


@dataclass(frozen=True)
class Pair(Record):
    """A step of the retrieval-synthesis variant: the state it is found by, its episode, and how it is told."""

    state: str
    episode: int
    block: str


class DynamicCheatsheet:
    """A sheet that the model rewrites from what happened (`cu`), or for what comes from what was like it (`rs`).

    Args:
        preset: `paper` or `rl`; see the module's docstring. The parameters that it sets are `None` here.
        variant: `cu` or `rs`.
        every: steps between two rewrites.
        top: `rs`: similar steps shown to the curator.
        sheet_tokens: most tokens of the sheet; a longer one loses its last lines.
        step_tokens: most tokens of a step in the curator's prompt.
        task_tokens: most tokens of the task's instruction there.
        tags: whether the sheet must stand between tags; otherwise the bare answer is the sheet.
        capacity: `rs`: steps kept; the oldest go first.
    """

    declaration = Declaration(
        "a cheat sheet that the model rewrites whole: cumulative, or synthesised from similar steps",
        calls=CallProfile(retrieve=(0, 1), store=(0, 1)),
        rl=CallProfile(retrieve=(0, 1), store=(0, 1)),
        purposes={
            "curate": Purpose(
                "store", "<cheatsheet>\n- DOUBLE() grows the number fastest. (used 2 times)\n</cheatsheet>"
            ),
            "synthesise": Purpose("retrieve", "<cheatsheet>\n- From 3, SUB() and DOUBLE() lead to 4.\n</cheatsheet>"),
        },
        needs=("embedder",),
        waived={"embedder": ("variant", "cu")},
        small=(
            {"every": 3, "sheet_tokens": 80},
            {"variant": "rs", "every": 2, "capacity": 4, "tags": False},
        ),
        aliases=("dc",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        variant: str = "cu",
        every: int | None = None,
        top: int | None = None,
        sheet_tokens: int | None = None,
        step_tokens: int | None = None,
        task_tokens: int | None = None,
        tags: bool | None = None,
        capacity: int = 1000,
    ) -> None:
        given = {"every": every, "top": top, "sheet_tokens": sheet_tokens, "step_tokens": step_tokens}
        chosen = settings("dynamic_cheatsheet", PRESETS, preset, {**given, "task_tokens": task_tokens, "tags": tags})
        one_of("dynamic_cheatsheet", variant=(variant, ("cu", "rs")))
        counts = {name: value for name, value in chosen.items() if name not in ("tags", "task_tokens")}
        at_least("dynamic_cheatsheet", 1, capacity=capacity, **counts)
        at_least("dynamic_cheatsheet", 0, task_tokens=chosen["task_tokens"])
        self.services = services
        self.variant = variant
        self.every: int = chosen["every"]
        self.top: int = chosen["top"]
        self.sheet_tokens: int = chosen["sheet_tokens"]
        self.step_tokens: int = chosen["step_tokens"]
        self.task_tokens: int = chosen["task_tokens"]
        self.tags: bool = chosen["tags"]
        self.capacity = capacity
        self._index = VectorIndex(services.embedder) if services.embedder and variant == "rs" else None
        self._sheet = ""
        self._since: list[str] = []  # steps that the sheet does not know, as the curator is told them
        self._unseen: list[int] = []  # `rs`: their keys
        self._lines: list[str] = []  # the same as the agent is told them
        self._waited = 0  # steps since the curator was last asked
        self._task = ""  # the instruction that the newest step followed
        self._due = False  # whether an earlier episode left something to be curated
        self._pairs: dict[int, Pair] = {}  # `rs`: steps by key
        self._rewrites = 0

    @property
    def sheet(self) -> str:
        """The sheet as it is."""
        return self._sheet

    def begin_episode(self, task: Task) -> None:
        self._due = bool(self._since) or bool(self._pairs)
        self._lines = []

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """The sheet, and the steps that it does not know yet (where the prompt does not tell these anyway)."""
        if self.variant == "rs":
            await self._synthesise(input, k or self.top)
        elif self._due:
            await self._curate()
        self._due = False
        text = f"{HEADER}\n{self._sheet}"
        items = [RecallItem(text, kind="summary", source=self._name, priority=math.inf)] if self._sheet else []
        since = enumerate(self._lines)
        items += [RecallItem(line, kind="step", source=self._name, priority=i) for i, line in since]
        return Recall(tuple(items))

    async def store(self, transition: Transition) -> None:
        block = telling.told(transition, self.step_tokens, self.services.llm.count_tokens)
        self._lines = [*self._lines, Experience.of(transition).line()][-self._most_waiting :]
        self._task = transition.input.instruction
        self._waited += 1
        if self.variant == "rs":
            self._keep(transition.input.text, block)
        if self.variant == "cu" or self.every > 1:
            self._since = [*self._since, block][-self._most_waiting :]
        if self.variant == "rs":
            return
        if self._waited >= self.every and not (transition.terminated or transition.truncated):
            await self._curate(transition.next_text)

    async def end_episode(self, trajectory: Trajectory) -> None:
        """What is left is curated with the outcome when the next episode of the run begins."""
        if not trajectory.transitions:
            return
        ended = telling.outcome(trajectory)
        if self.variant == "cu" or self.every > 1:
            self._since = [*self._since, ended][-self._most_waiting :]
        if self._pairs:
            newest = next(reversed(self._pairs))
            pair = self._pairs[newest]
            self._pairs[newest] = replace(pair, block=f"{pair.block}\n{ended}")

    @property
    def _name(self) -> str:
        return self.services.llm.module

    @property
    def _most_waiting(self) -> int:
        """Steps that wait for a curator who cannot be asked or does not answer."""
        return 2 * self.every + 1

    # -- curation --------------------------------------------------------------------------------------------------

    async def _curate(self, next_text: str = "") -> None:
        """`cu`: the sheet anew from the steps since."""
        steps = f"{telling.STEPS}\n{telling.numbered(self._since)}"
        now = prompts.LEADS_TO.format(state=self._state(next_text)) if next_text else prompts.NEW
        await self._rewrite("curate", self._task, [steps, now], "")

    async def _synthesise(self, input: AgentInput, top: int) -> None:
        """`rs`: the sheet anew for the present state, from the past steps most similar to it."""
        if self._index is None or not self._pairs or not (self._due or self._waited >= self.every):
            return
        found = self._similar(input.text, top)
        now = self.services.time().episode
        pairs = [
            f"{telling.when(self._pairs[key].episode, now)}Similarity {score:.2f}:\n{self._pairs[key].block}"
            for key, score in found
        ]
        shown = [f"{prompts.SIMILAR}\n{telling.numbered(pairs)}"] if pairs else []
        since = [f"{telling.STEPS}\n{telling.numbered(self._since)}"] if self._since else []
        state = prompts.NOW.format(state=self._state(input.text))
        await self._rewrite("synthesise", input.instruction, [*shown, *since, state], " for the present state")

    def _similar(self, text: str, top: int) -> list[tuple[int, float]]:
        """Keys of the steps to be shown with their similarity, least similar first; of earlier episodes if there are
        enough."""
        assert self._index is not None
        scores, keys = self._index.scores(text), list(self._pairs)  # in the same order
        of = np.fromiter((pair.episode for pair in self._pairs.values()), dtype=np.int64, count=len(keys))
        known = np.arange(len(keys)) >= len(keys) - len(self._unseen)  # they are the newest
        earlier = (of != self.services.time().episode) & ~known
        found: list[tuple[int, float]] = []
        for among in (earlier, ~earlier & ~known):
            rows = np.flatnonzero(among)
            best = rows[top_rows(scores[rows], top - len(found))]
            found += [(keys[row], float(scores[row])) for row in best]
        return sorted(found, key=lambda pair: pair[1])

    async def _rewrite(self, purpose: str, instruction: str, parts: list[str], where: str) -> None:
        room = self._room
        form = prompts.TAGGED if self.tags else prompts.BARE
        request = prompts.REQUEST.format(where=where, words=max(1, room * 3 // 4), form=form)
        sheet = prompts.SHEET.format(sheet=self._sheet or "(empty)")
        prompt: tuple[Message, ...] = (
            system(
                prompts.CURATOR.format(
                    task=clip_text(instruction.strip(), self.task_tokens, self._count) or "(not told)"
                )
            ),
            user("\n\n".join([sheet, *parts, request])),
        )
        parse = Parser(lambda text: read_sheet(text, self.tags), "the sheet between its tags", repairs=0)
        self._waited = 0
        answer = await self.services.ask(purpose, prompt, room + room // 4 + 32, parse)
        cut = answer.call is not None and answer.call.completions[0].finish_reason == "length"
        if answer.value is None or (cut and not self.tags):
            if answer.value is not None:
                self.services.count("truncated")
            return
        self._sheet = self._fit(answer.value, room)
        self._lines = [] if self._since else self._lines[-1:]  # the newest step, where the curator was not told of it
        self._since, self._unseen = [], []
        self._rewrites += 1

    @property
    def _room(self) -> int:
        """Tokens of the sheet: it shall be shown whole."""
        shown = self.services.context.recall_tokens - self._count(HEADER) - 2
        return min(self.sheet_tokens, shown) if shown > 0 else self.sheet_tokens

    def _fit(self, sheet: str, room: int) -> str:
        """The sheet without the last lines that have no room."""
        if self._count(sheet) <= room:
            return sheet
        lines = telling.within(sheet.splitlines(), room, self._count)
        return "\n".join(lines).strip() or clip_text(sheet, room, self._count)

    def _state(self, text: str) -> str:
        return excerpt(text, self.step_tokens, self._count)

    def _count(self, text: str) -> int:
        return self.services.llm.count_tokens(text)

    def _keep(self, state: str, block: str) -> None:
        """`rs`: keep a step to be found again by its state."""
        if self._index is None:
            return
        key = self.services.new_id()
        self._index.put(key, state)
        self._pairs[key] = Pair(state, self.services.time().episode, block)
        if self.every > 1:
            self._unseen = [*self._unseen, key][-self._most_waiting :]
        while len(self._pairs) > self.capacity:
            oldest = next(iter(self._pairs))
            del self._pairs[oldest]
            self._index.remove(oldest)

    # -- state -----------------------------------------------------------------------------------------------------

    def metrics(self) -> dict[str, int]:
        """Rewrites so far, tokens of the sheet, and steps that can be looked up."""
        return {"rewrites": self._rewrites, "sheet_tokens": self._count(self._sheet), "steps": len(self._pairs)}

    def snapshot(self) -> bytes:
        flags = [self._waited, self._due, self._rewrites, self._task]
        return dump_state([self._sheet, self._since, self._unseen, self._lines, flags, keyed(self._pairs)])

    def restore(self, blob: bytes) -> None:
        self._sheet, self._since, self._unseen, self._lines, flags, pairs = load_state(blob)
        self._waited, self._due, self._rewrites, self._task = flags
        self._pairs = {key: Pair(*row) for key, row in pairs}
        if self._index is not None:
            self._index.load([(key, pair.state) for key, pair in self._pairs.items()])
