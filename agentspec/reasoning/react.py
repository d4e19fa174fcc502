"""ReAct (Yao et al., 2023): thought, action and observation in one growing transcript.

A thought is a turn of its own that the scaffold acknowledges; it uses a step of the loop and none of the environment.
With free-text actions one completion may hold thought and action; an answer without an action is a thought, and after
``max_iterations`` of those the next call is asked for the action alone. In menu mode a thought is followed by the
action, decoded under the menu's constraint. A completion never writes observations: it is stopped where it begins one.

In the ``conversation`` layout the transcript is the context itself; in ``snapshot`` it is rendered into the user turn.
"""

from __future__ import annotations

import re

from agentspec.actions import parse_action
from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.protocols import Services
from agentspec.reasoning.common import ask_action, default_answer, last_action_line, sampled, static_prompt, user_turn
from agentspec.state import dump_state, load_state
from agentspec.types import Action, ActionError, AgentInput, Decision, LLMCall, Recall, Task, Transition

FORMAT = (
    "Work in turns. Write what you think in one or two sentences after 'Thought:', then one line "
    "'Action: NAME(arguments)'. The result comes back as the next observation; never write it yourself."
)
FORMAT_MENU = (
    "Work in turns: first write what you think in one sentence; once it is acknowledged, answer with one of the "
    "listed actions, word for word."
)
ACKNOWLEDGED = "OK."
STOP = ("\nObservation:", "Observation:")


class ReAct:
    """Interleaved thought and action.

    Args:
        max_iterations: consecutive thoughts before the action is asked for alone.
        thought_tokens: most tokens of a thought (``None``: the spec's ``max_tokens``).
        history: steps of transcript shown in the ``snapshot`` layout.
    """

    declaration = Declaration(
        "a growing transcript of thought, action and observation",
        calls=CallProfile(step=(1, 11)),
        purposes=Purpose.each("step", "think", "act"),
    )

    def __init__(
        self,
        services: Services,
        max_iterations: int = 10,
        thought_tokens: int | None = None,
        history: int = 10,
    ) -> None:
        if max_iterations < 1:
            raise ValueError(f"react: max_iterations must be at least 1, got {max_iterations}")
        self.services = services
        self.max_iterations = max_iterations
        self.limit = {} if thought_tokens is None else {"max_tokens": thought_tokens}
        self.history = history
        self._transcript: list[str] = []

    def begin_episode(self, task: Task) -> None:
        self._transcript = []

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        schema = input.action_schema
        static = static_prompt(input, FORMAT_MENU if schema.choices else FORMAT)
        messages = self.services.context.prompt(static, self._dynamic(input, recall))
        thoughts: list[LLMCall] = []
        allowed = 1 if schema.choices else self.max_iterations
        purpose = "think" if schema.choices else "act"
        while len(thoughts) < allowed:
            call = await self.services.llm.generate(purpose, messages, stop=STOP, **self.limit)
            answer = None if schema.choices else last_action_line(call.text)
            if answer is not None:
                return self._decision(parse_action(answer, schema), thoughts, call, call.text)
            thoughts.append(call)
            last = len(thoughts) == allowed
            reply = f"{ACKNOWLEDGED} {default_answer(schema)}" if last else ACKNOWLEDGED
            messages = self.services.context.think((sampled(call),), reply)
        action, call = await ask_action(self.services, messages, schema)
        return self._decision(action, thoughts, call, "\n".join(t.text for t in thoughts))

    def _dynamic(self, input: AgentInput, recall: Recall) -> str:
        text = user_turn(input, recall, self.services)
        if self.services.context.layout == "snapshot" and self._transcript:
            return "Transcript so far:\n" + "\n".join(self._transcript[-self.history :]) + f"\n\n{text}"
        return text

    @staticmethod
    def _decision(action: Action | ActionError, thoughts: list[LLMCall], call: LLMCall, rationale: str) -> Decision:
        return Decision(
            action,
            rationale=rationale,
            calls=(*((t.id, 0) for t in thoughts), (call.id, 0)),
            valid=isinstance(action, Action),
            turn=(sampled(call),),
        )

    async def observe(self, transition: Transition) -> None:
        thought = _thought(transition.decision.rationale)
        result = transition.info.get("error") or transition.info.get("message") or "done"
        self._transcript.append(f"Thought: {thought}\nAction: {transition.action_text}\nObservation: {result}")

    def snapshot(self) -> bytes:
        return dump_state(self._transcript)

    def restore(self, blob: bytes) -> None:
        self._transcript = load_state(blob)


def _thought(rationale: str) -> str:
    """The thought alone, on one line: without its label and without the action that follows it."""
    thought = re.split(r"\baction\s*:", rationale, maxsplit=1, flags=re.IGNORECASE)[0]
    return " ".join(re.sub(r"^\s*thought\s*:", "", thought, flags=re.IGNORECASE).split())
