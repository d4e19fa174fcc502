"""Periodic summaries: the memory of SUPO (Summarisation-augmented Policy Optimisation, arXiv 2510.06727).

Every ``every`` actions (AgentSpec's schedule), or once the context holds ``threshold_tokens`` (the SUPO paper's), the
policy writes a summary of its trajectory so far. The conversation then starts over from the task prompt plus the
summary, so the context stays bounded however long the episode is. Each stretch between two summaries is one token
sequence that ends in the summary's own tokens: these are the policy's choices like any other, and they are trained.

What the last action did is not lost: its result stands in the prompt of the summary, and the next observation shows
the state it led to. The same module serves evaluation, so a policy meets the contexts it was trained in.
"""

from __future__ import annotations

import math

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, user
from agentspec.memory.base import describe
from agentspec.protocols import Services
from agentspec.state import dump_state, load_state
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, RecallItem, Task, Transition

ASK = (
    "Your notes will be all you remember of this episode. Summarise it now: what was done, what is under way "
    "(orders, places, times, battery, energy), what was learnt, and what to do next. Write a few short sentences."
)
CARRY = "Summary of the episode so far:\n{summary}"


class SummaryMemory:
    """Summaries that replace the conversation.

    Args:
        every: actions between summaries (0: only by ``threshold_tokens``).
        threshold_tokens: also summarise once prompt and answer of the last call hold this many tokens (0: off).
        max_summaries: most summaries of an episode (0: no limit); after these the context grows until it is full,
            and the episode ends there.
        summary_tokens: most tokens of a summary.
    """

    declaration = Declaration(
        "SUPO: the policy's own summary replaces the conversation every 8 actions",
        calls=CallProfile(store=(0, 1)),
        purposes={"summary": Purpose("store", example="Took two orders; the first is delivered.")},
        small=({"every": 3}, {"every": 0, "threshold_tokens": 300}),
    )

    def __init__(
        self,
        services: Services,
        every: int = 8,
        threshold_tokens: int = 0,
        max_summaries: int = 0,
        summary_tokens: int = 192,
    ) -> None:
        if every < 0 or threshold_tokens < 0 or not (every or threshold_tokens):
            raise ValueError(
                f"memory summary: every={every}, threshold_tokens={threshold_tokens}; one of them must be positive"
            )
        self.services = services
        self.every = every
        self.threshold_tokens = threshold_tokens
        self.max_summaries = max_summaries
        self.summary_tokens = summary_tokens
        self._actions = 0
        self._summaries = 0
        self._summary = ""
        self._lines: list[str] = []

    def begin_episode(self, task: Task) -> None:
        self._actions, self._summaries, self._summary, self._lines = 0, 0, "", []

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """Nothing in a conversation (the summary stands in the context); otherwise summary and steps since."""
        if self.services.context.layout == "conversation":
            return Recall()
        carried = [CARRY.format(summary=self._summary)] if self._summary else []
        items = [RecallItem(text, kind="summary", source="memory.summary", priority=math.inf) for text in carried]
        since = [
            RecallItem(line, kind="step", source="memory.summary", priority=i) for i, line in enumerate(self._lines)
        ]
        return Recall((*items, *since))

    async def store(self, transition: Transition) -> None:
        self._actions += 1
        self._lines.append(describe(transition))
        if transition.terminated or transition.truncated or not self._due():
            return
        answer = await self.services.ask("summary", self._prompt(transition), self.summary_tokens, credit="executed")
        if answer.value is None:  # nothing was written: the conversation stays, and the next step asks again
            return
        self._summary = answer.value
        self._summaries += 1
        self._actions = 0
        self._lines = []
        if self.services.context.layout == "conversation":
            self.services.context.restart(CARRY.format(summary=self._summary))

    def _due(self) -> bool:
        if self.max_summaries and self._summaries >= self.max_summaries:
            return False
        if self.every and self._actions >= self.every:
            return True
        return bool(self.threshold_tokens) and self._context_tokens() >= self.threshold_tokens

    def _context_tokens(self) -> int:
        """Tokens of the newest acting call, prompt and answer."""
        calls = [c for c in self.services.llm.recorder.calls if c.tag.purpose != "summary"]
        return len(calls[-1].prompt_ids) + len(calls[-1].completions[0].token_ids) if calls else 0

    def _prompt(self, transition: Transition) -> tuple[Message, ...]:
        """The context as it is, the result of the last action, and the request for a summary."""
        context = self.services.context
        if context.layout == "conversation":
            return (*context.messages, user(f"{transition.next_text}\n\n{ASK}"))
        before = f"{CARRY.format(summary=self._summary)}\n" if self._summary else ""
        steps = "\n".join(self._lines)
        return (*context.messages[:1], user(f"{before}{steps}\n\n{transition.next_text}\n\n{ASK}"))

    async def end_episode(self, trajectory: Trajectory) -> None:
        return None

    def snapshot(self) -> bytes:
        return dump_state([self._actions, self._summaries, self._summary, self._lines])

    def restore(self, blob: bytes) -> None:
        self._actions, self._summaries, self._summary, self._lines = load_state(blob)
