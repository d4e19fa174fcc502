"""Chain of thought (Wei et al., 2022): think step by step, then act. The chain is not carried to the next step.

With free-text actions one call writes the chain and a last line ``Action: ...``. In menu mode the chain is one call and
the action a second one, decoded under the menu's constraint with the chain in its prompt. With ``enable_history`` the
chains do stay in the conversation, as sampled.
"""

from __future__ import annotations

from agentspec.actions import parse_action
from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import assistant, user
from agentspec.protocols import Services
from agentspec.reasoning.common import (
    MENU_ANSWER,
    Stateless,
    ask_action,
    last_action_line,
    sampled,
    static_prompt,
    user_turn,
)
from agentspec.types import Action, AgentInput, Decision, Recall

THINK_THEN_CALL = (
    "First think step by step about where you are, what pays and what the clock allows. "
    "Then end with one line of the form\nAction: NAME(arguments)"
)
THINK = "Think step by step in at most three short sentences; do not name the action yet."


class ChainOfThought(Stateless):
    """A chain of thought per decision.

    Args:
        thought_tokens: most tokens of a chain (``None``: the spec's ``max_tokens``).
        enable_history: keep the chains in the conversation.
    """

    declaration = Declaration(
        "thinks step by step, then acts; the chain is not carried on",
        calls=CallProfile(step=(1, 2)),
        purposes=Purpose.each("step", "think", "act"),
    )

    def __init__(
        self,
        services: Services,
        thought_tokens: int | None = None,
        enable_history: bool = False,
    ) -> None:
        self.services = services
        self.history = enable_history
        self.limit = {} if thought_tokens is None else {"max_tokens": thought_tokens}

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        if input.action_schema.choices:
            return await self._think_then_choose(input, recall)
        dynamic = user_turn(input, recall, self.services)
        messages = self.services.context.prompt(static_prompt(input, THINK_THEN_CALL), dynamic)
        call = await self.services.llm.generate("act", messages, **self.limit)
        answer = last_action_line(call.text)
        action = parse_action(call.text if answer is None else answer, input.action_schema)
        valid = isinstance(action, Action)
        turn = sampled(call) if self.history else action.text
        return Decision(action, rationale=call.text, calls=((call.id, 0),), valid=valid, turn=(turn,))

    async def _think_then_choose(self, input: AgentInput, recall: Recall) -> Decision:
        dynamic = user_turn(input, recall, self.services)
        messages = self.services.context.prompt(static_prompt(input, THINK), dynamic)
        thought = await self.services.llm.generate("think", messages, **self.limit)
        if self.history:
            follow_up = self.services.context.think((sampled(thought),), MENU_ANSWER)
        else:
            follow_up = (*messages, assistant(sampled(thought)), user(MENU_ANSWER))
        action, call = await ask_action(self.services, follow_up, input.action_schema)
        return Decision(
            action,
            rationale=thought.text,
            calls=((thought.id, 0), (call.id, 0)),
            valid=isinstance(action, Action),
            turn=(sampled(call),),
        )
