"""Direct: the action and nothing else. One call, no rationale."""

from __future__ import annotations

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.protocols import Services
from agentspec.reasoning.common import Stateless, ask_action, default_answer, sampled, static_prompt, user_turn
from agentspec.types import Action, AgentInput, Decision, Recall


class Direct(Stateless):
    """Answers with the action only."""

    declaration = Declaration(
        "answers with the action only",
        calls=CallProfile(step=(1, 1)),
        purposes=Purpose.each("step", "act"),
    )

    def __init__(self, services: Services) -> None:
        self.services = services

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        static = static_prompt(input, default_answer(input.action_schema))
        dynamic = user_turn(input, recall, self.services)
        messages = self.services.context.prompt(static, dynamic)
        action, call = await ask_action(self.services, messages, input.action_schema)
        return Decision(action, calls=((call.id, 0),), valid=isinstance(action, Action), turn=(sampled(call),))
