"""The running prompt of an episode, in one of two layouts.

``conversation`` is append-only: every step adds a user turn (the new observation) and the assistant's turn exactly as
it was sampled, so each prompt extends the one before and the whole episode is one token sequence. ``snapshot`` rebuilds
the prompt at every step from the task and the current observation; what happened before is memory's business.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Literal

from agentspec.llm.base import Message, assistant, system, user
from agentspec.state import dump_state, load_state
from agentspec.types import Part, Sampled

Layout = Literal["conversation", "snapshot"]


class Context:
    """The conversation of one episode.

    Args:
        layout: see the module's docstring.
        max_turns: in ``conversation``, start over with the newest turns once more than this many user turns are held
            (0: never). Starting over breaks the prefix: the next prompt begins a new training sequence.
    """

    def __init__(self, layout: Layout = "conversation", max_turns: int = 0) -> None:
        if layout not in ("conversation", "snapshot"):
            raise ValueError(f"layout must be 'conversation' or 'snapshot', got {layout!r}")
        self.layout = layout
        self.max_turns = max_turns
        self.carry = ""
        self._static = ""
        self._turns: list[Message] = []
        self._open: Message | None = None

    def prompt(self, static: str, dynamic: str) -> tuple[Message, ...]:
        """Messages for this step: system text, the turns so far, and a user turn with ``dynamic``.

        Calling it again in the same step (several agents of a debate, say) replaces the open user turn.
        """
        self._static = static
        if self.layout == "snapshot":
            self._turns = []
        elif self.max_turns and len(self._turns) >= 2 * self.max_turns:
            self._turns = self._turns[-2 * (self.max_turns // 2) :] if self.max_turns > 1 else []
        text = f"{self.carry}\n\n{dynamic}" if self.carry and not self._turns else dynamic
        self._open = user(text)
        return (system(static), *self._turns, self._open)

    def think(self, parts: Sequence[Part], reply: str) -> tuple[Message, ...]:
        """An assistant turn that is not the action yet, answered by ``reply``: the prompt of the turn after it."""
        if self._open is None:
            raise ValueError("think() before prompt(): there is no open user turn to answer")
        self._turns += [self._open, assistant(*parts)]
        self._open = user(reply)
        return (system(self._static), *self._turns, self._open)

    def close(self, parts: Sequence[Part]) -> None:
        """The assistant's turn of this step, as it shall stand in later prompts."""
        if self._open is None:
            return
        self._turns += [self._open, assistant(*parts)]
        self._open = None

    @property
    def messages(self) -> tuple[Message, ...]:
        """All closed turns with the system text in front: what a summary is made of."""
        return (system(self._static), *self._turns)

    def restart(self, carry: str) -> None:
        """Forget all turns; ``carry`` (a summary, say) stands before the next user turn until it is replaced."""
        self._turns = []
        self._open = None
        self.carry = carry

    def snapshot(self) -> bytes:
        """Exact state as bytes."""
        turns = [{"role": m.role, "content": [_part_to_json(p) for p in m.content]} for m in self._turns]
        opened = None if self._open is None else self._open.text
        return dump_state({"static": self._static, "carry": self.carry, "turns": turns, "open": opened})

    def restore(self, blob: bytes) -> None:
        """Return to a snapshot."""
        data = load_state(blob)
        self._static, self.carry = data["static"], data["carry"]
        self._turns = [Message(t["role"], tuple(_part_from_json(p) for p in t["content"])) for t in data["turns"]]
        self._open = None if data["open"] is None else user(data["open"])


def _part_to_json(part: Part) -> Any:
    return part if isinstance(part, str) else asdict(part)


def _part_from_json(data: Any) -> Part:
    return data if isinstance(data, str) else Sampled(data["text"], tuple(data["token_ids"]))
