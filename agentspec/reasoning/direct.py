"""Direct: the action and nothing else.

One call per step, no rationale asked for; a model that reasons before it answers does so at its own expense, within the
spec's `reasoning_tokens`. An answer without an action is asked for again at most `max_retries` times.
"""

from __future__ import annotations

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.parameters import at_least
from agentspec.prompting import MAX_RETRIES, ask_action, default_answer, sampled, static_prompt, user_turn
from agentspec.reasoning.common import Stateless
from agentspec.services import Services
from agentspec.types import AgentInput, Decision, Recall


class Direct(Stateless):
    """Answers with the action only.

    Args:
        max_retries: further calls for an answer that holds no action.
    """

    declaration = Declaration(
        "answers with the action only",
        calls=CallProfile(step=(1, 3)),
        purposes=Purpose.each("step", "act"),
        aliases=("none",),
    )

    def __init__(self, services: Services, max_retries: int = MAX_RETRIES) -> None:
        at_least("direct", 0, max_retries=max_retries)
        self.services = services
        self.max_retries = max_retries

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        schema = input.action_schema
        static = static_prompt(input, default_answer(schema))
        messages = self.services.context.prompt(static, user_turn(input, recall, self.services))
        acted = await ask_action(self.services, messages, schema, max_retries=self.max_retries)
        return Decision(acted.action, calls=acted.calls, valid=acted.valid, turn=(sampled(acted.call),))
