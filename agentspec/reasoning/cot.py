"""Chain of thought (Wei et al., 2022): think step by step, then act. The chain is not carried to the next step.

The paper writes chain and answer in one completion, and so does this: free-text actions cost one call per step. In menu
mode the chain is one call and the action a second one, decoded under the menu's constraint with the chain in its
prompt. With `enable_history` the chains do stay in the conversation, as sampled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message
from agentspec.parameters import at_least
from agentspec.prompting import (
    MAX_RETRIES,
    MENU_ANSWER,
    ask_action,
    in_context,
    in_private,
    sampled,
    static_prompt,
    user_turn,
)
from agentspec.reasoning.common import Stateless
from agentspec.services import Services
from agentspec.types import AgentInput, Decision, Recall

THINK_THEN_CALL = (
    "First think step by step about where things stand, what serves the task best and what time allows. "
    "Then end with one line of the form\nAction: NAME(arguments)"
)
THINK = "Think step by step in at most three short sentences; do not name the action yet."


class ChainOfThought(Stateless):
    """A chain of thought per decision.

    Args:
        thought_tokens: most tokens of a chain (`None`: the spec's `max_tokens`).
        enable_history: keep the chains in the conversation.
        max_retries: further calls for an answer that holds no action.
    """

    declaration = Declaration(
        "thinks step by step, then acts; the chain is not carried on",
        calls=CallProfile(step=(1, 4)),
        purposes=Purpose.each("step", "think", "act"),
    )

    def __init__(
        self,
        services: Services,
        thought_tokens: int | None = None,
        enable_history: bool = False,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        at_least("cot", 0, max_retries=max_retries)
        self.services = services
        self.history = enable_history
        self.limit: dict[str, Any] = {} if thought_tokens is None else {"max_tokens": thought_tokens}
        self.max_retries = max_retries
        self.follow_up = in_context(services) if enable_history else in_private

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        menu = bool(input.action_schema.choices)
        static = static_prompt(input, THINK if menu else THINK_THEN_CALL)
        messages = self.services.context.prompt(static, user_turn(input, recall, self.services))
        return await (self._think_then_choose if menu else self._think_and_act)(input, messages)

    async def _think_and_act(self, input: AgentInput, messages: Sequence[Message]) -> Decision:
        acted = await ask_action(
            self.services,
            messages,
            input.action_schema,
            max_retries=self.max_retries,
            follow_up=self.follow_up,
            **self.limit,
        )
        turn = sampled(acted.call) if self.history else acted.action.text
        return Decision(acted.action, rationale=acted.call.text, calls=acted.calls, valid=acted.valid, turn=(turn,))

    async def _think_then_choose(self, input: AgentInput, messages: Sequence[Message]) -> Decision:
        thought = await self.services.llm.generate("think", messages, **self.limit)
        acted = await ask_action(
            self.services,
            self.follow_up(messages, sampled(thought), MENU_ANSWER),
            input.action_schema,
            max_retries=self.max_retries,
            follow_up=self.follow_up,
        )
        return Decision(
            acted.action,
            rationale=thought.text,
            calls=((thought.id, 0), *acted.calls),
            valid=acted.valid,
            turn=(sampled(acted.call),),
        )
