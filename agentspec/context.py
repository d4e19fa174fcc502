"""The running prompt of an episode, in one of two layouts.

`conversation` is append-only: every step adds a user turn (the new observation) and the assistant's turn exactly as it
was sampled, so each prompt extends the one before and the whole episode is one token sequence. `snapshot` rebuilds the
prompt at every step from the task and the current observation; what happened before is memory's business.

What memory and reflection contribute to a step (`recalled`) is part of its user turn. With `recall="newest"` it stands
in the newest user turn only: once the step is over it is taken out again, so that memory replaces what it knew and does
not pile up; a prompt then no longer extends the one before from the first recalled line on. With `recall="kept"` it
stays in every turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Literal

from agentspec.llm.base import Message, assistant, system, user
from agentspec.shapes import plan_of
from agentspec.state import dump_state, load_state
from agentspec.tokens import CountTokens, estimate_tokens
from agentspec.types import Part, Picture, Recall, Sampled

Layout = Literal["conversation", "snapshot"]
Placement = Literal["newest", "kept"]

LESSONS = "Lessons from earlier trials:\n{text}"
MEMORY = "Memory:\n{text}"
PLAN = "Your last plan: {text}"


class Context:
    """The conversation of one episode.

    Args:
        layout: see the module's docstring.
        max_turns: in `conversation`, start over with the newest turns once more than this many user turns are held
            (0: never). Starting over breaks the prefix: the next prompt begins a new training sequence.
        recall: where what is recalled stands, see the module's docstring.
        recall_tokens: most tokens of what memory recalls in one step.
        lesson_tokens: most tokens of lessons in one step.
        count_tokens: how tokens are counted; the model's own counter in an episode.
        window: tokens the model's context holds (0: unknown).
    """

    def __init__(
        self,
        layout: Layout = "conversation",
        max_turns: int = 0,
        *,
        recall: Placement = "newest",
        recall_tokens: int = 512,
        lesson_tokens: int = 256,
        count_tokens: CountTokens = estimate_tokens,
        window: int = 0,
    ) -> None:
        if layout not in ("conversation", "snapshot"):
            raise ValueError(f"layout must be 'conversation' or 'snapshot', got {layout!r}")
        if recall not in ("newest", "kept"):
            raise ValueError(f"recall must be 'newest' or 'kept', got {recall!r}")
        self.layout = layout
        self.max_turns = max_turns
        self.placement = recall
        self.recall_tokens = recall_tokens
        self.lesson_tokens = lesson_tokens
        self.window = window
        self.carry = ""
        self.plan = ""
        """What the agent last wrote into an answer as its plan."""
        self.transcript = ""
        """The transcript that the reasoner's prompt of this step shows, for those who judge what it decides."""
        self.pictures: tuple[Picture, ...] = ()
        """What the current step sees: part of its prompts, and of nothing that is kept."""
        self._count = count_tokens
        self._static = ""
        self._turns: list[Message] = []
        self._steps: list[int] = []  # at which of the turns each step begins
        self._open: Message | None = None
        self._running = False  # whether a step is under way
        self._recalled: list[str] = []  # its blocks

    def recalled(self, recall: Recall) -> str:
        """What `recall` adds in front of this step's observation: lessons, then memories, each within its budget, and
        the agent's last plan, unless the conversation still holds it.

        Every block ends in an empty line; nothing recalled is the empty string. Write it into the user turn of the
        step's prompts: it is taken out of the conversation again where `recall="newest"`.
        """
        lessons = recall.lessons.render(self.lesson_tokens, self._count)
        memories = recall.memories.render(self.recall_tokens, self._count)
        blocks = ((LESSONS, lessons), (MEMORY, memories), (PLAN, "" if self._holds_plan() else self.plan))
        text = "".join(f"{block.format(text=shown)}\n\n" for block, shown in blocks if shown)
        if text and text not in self._recalled:
            self._recalled.append(text)
        return text

    def prompt(self, static: str, dynamic: str) -> tuple[Message, ...]:
        """Messages for this step: system text, the turns so far, and a user turn with `dynamic`.

        Calling it again in the same step (several agents of a debate, say) replaces the open user turn.
        """
        self._static = static
        if self.layout == "snapshot":
            self._forget_turns(0)
        elif not self._running:
            self._forget_turns(self._left())
        if not self._running or not self._steps:
            self._steps.append(len(self._turns))
        self._running = True
        self._open = user(dynamic)
        return self._all(self._open)

    def think(self, parts: Sequence[Part], reply: str) -> tuple[Message, ...]:
        """An assistant turn that is not the action yet, answered by `reply`: the prompt of the turn after it."""
        if self._open is None:
            raise ValueError("think() before prompt(): there is no open user turn to answer")
        self._turns += [self._open, assistant(*parts)]
        self._open = user(reply)
        return self._all(self._open)

    def close(self, parts: Sequence[Part]) -> None:
        """The assistant's turn of this step, as it shall stand in later prompts; what was recalled is taken out."""
        recalled, self._recalled, self._running = self._recalled, [], False
        if self._open is None:
            return
        self._turns += [self._open, assistant(*parts)]
        self._open = None
        if self.placement == "newest" and recalled:
            first = self._steps[-1]
            self._turns[first:] = [_without(turn, recalled) for turn in self._turns[first:]]

    @property
    def messages(self) -> tuple[Message, ...]:
        """All closed turns with the system text in front: what a summary is made of."""
        return self._all()

    def tokens(self) -> int:
        """About how many tokens the conversation holds now (its text, without what a chat template adds)."""
        return sum(self._count(m.text) for m in self._all(*([self._open] if self._open else [])))

    @property
    def steps(self) -> int:
        """Number of steps whose turns the conversation holds."""
        return len(self._steps) - self._running

    @property
    def told(self) -> int:
        """How many of the newest steps the turns of the next step's prompt tell (0 in `snapshot`)."""
        if self.layout == "snapshot":
            return 0
        gone = len(self._turns) - self._left()
        return sum(start >= gone for start in self._steps) - self._running

    def older(self, keep: int) -> tuple[Message, ...]:
        """The turns of all steps but the newest `keep`: what `evict` would forget."""
        return tuple(self._turns[: self._start(keep)])

    def evict(self, keep: int, carry: str = "") -> tuple[Message, ...]:
        """Forget the turns of all steps but the newest `keep`; between two steps only.

        `carry` (a summary of them, say) stands before the first user turn from now on, in place of the carry before.

        Returns:
            The turns that were forgotten, oldest first.

        Raises:
            ValueError: a step is under way, or `keep` is negative.
        """
        if keep < 0 or self._running:
            raise ValueError(
                f"evict(keep={keep}) {'in the middle of a step' if self._running else 'needs keep >= 0'}; call it in "
                "a memory's retrieve() or store()"
            )
        forgotten = self.older(keep)
        self._forget_turns(len(self._turns) - len(forgotten))
        self.carry = carry
        return forgotten

    def restart(self, carry: str) -> None:
        """Forget all turns; `carry` (a summary, say) stands before the first user turn until it is replaced."""
        self._open, self._running = None, False
        self.evict(0, carry)

    def snapshot(self) -> bytes:
        """Exact state as bytes."""
        turns = [
            {"role": m.role, "content": [_part_to_json(p) for p in m.content if not isinstance(p, Picture)]}
            for m in self._turns
        ]
        opened = None if self._open is None else self._open.text
        return dump_state(
            {
                "static": self._static,
                "carry": self.carry,
                "plan": self.plan,
                "turns": turns,
                "steps": self._steps,
                "open": opened,
                "running": self._running,
                "recalled": self._recalled,
            }
        )

    def restore(self, blob: bytes) -> None:
        """Return to a snapshot."""
        data = load_state(blob)
        self._static, self.carry, self.plan = data["static"], data["carry"], data["plan"]
        self._turns = [Message(t["role"], tuple(_part_from_json(p) for p in t["content"])) for t in data["turns"]]
        self._steps, self._running, self._recalled = data["steps"], data["running"], data["recalled"]
        self._open = None if data["open"] is None else user(data["open"])

    def _all(self, *more: Message) -> tuple[Message, ...]:
        """System text, the turns, and `more`, with the carry before the first user turn."""
        turns = [*self._turns, *more]
        if self.carry and turns:
            turns[0] = user(f"{self.carry}\n\n{turns[0].text}")
        if self.pictures and self._running:
            first = self._steps[-1]
            turns[first] = user(turns[first].text, *self.pictures)
        return (system(self._static), *turns)

    def _holds_plan(self) -> bool:
        """Whether a turn that the next prompt keeps says the plan as it is now."""
        kept = self._turns[len(self._turns) - self._left() :] if self.plan and self.layout == "conversation" else []
        said = (plan_of(m.text) if m.role == "assistant" else m.text for m in kept)
        return any(text == self.plan or PLAN.format(text=self.plan) in text for text in said)

    def _left(self) -> int:
        """How many of the turns the next step's prompt begins with: all, or the newest where it starts over."""
        if not self.max_turns or len(self._turns) < 2 * self.max_turns:
            return len(self._turns)
        return 2 * (self.max_turns // 2) if self.max_turns > 1 else 0

    def _start(self, keep: int) -> int:
        """At which turn the newest `keep` steps begin."""
        if keep == 0 or not self._steps:
            return len(self._turns)
        return self._steps[-keep] if keep <= len(self._steps) else 0

    def _forget_turns(self, left: int) -> None:
        """Keep the newest `left` messages."""
        gone = len(self._turns) - left
        self._turns = self._turns[gone:]
        self._steps = [s - gone for s in self._steps if s >= gone]


def _without(turn: Message, recalled: Sequence[str]) -> Message:
    """A user turn without the blocks that were recalled; an assistant's turn as it is."""
    if turn.role != "user":
        return turn
    text = turn.text
    for block in recalled:
        text = text.replace(block, "", 1)
    return user(text)


def _part_to_json(part: Part) -> Any:
    return part if isinstance(part, str) else asdict(part)


def _part_from_json(data: Any) -> Part:
    return data if isinstance(data, str) else Sampled(data["text"], tuple(data["token_ids"]))
