"""What all reasoners share: the static prompt, the user turn, and asking for one action.

Static text (instruction, actions, how to answer) goes first and is the same at every step of a task; recalled memory
and the observation follow. In menu mode the answer is decoded under the constraint of the listed actions; otherwise
it is free text that the parser reads.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from agentspec.actions import parse_action
from agentspec.llm.base import Message
from agentspec.protocols import Services
from agentspec.types import Action, ActionError, ActionSchema, AgentInput, LLMCall, Recall, Sampled, Task, Transition

MENU_ANSWER = "Answer with one of the listed actions, word for word."
CALL_ANSWER = "Answer with exactly one action call and nothing else."

_ACTION_LINE = re.compile(r"\baction[\s*`]*:[\s*`]*(\S[^\n]*)", re.IGNORECASE)


def static_prompt(input: AgentInput, answer: str) -> str:
    """Instruction, the actions (unless they are listed in every observation), and how to answer."""
    parts = [input.instruction.strip()]
    if not input.action_schema.choices:
        parts.append("Actions:\n" + render_actions(input.action_schema))
    parts.append(answer)
    return "\n\n".join(parts)


def render_actions(schema: ActionSchema) -> str:
    """One line per action: an example call and what it does."""
    lines = []
    for spec in schema.actions.values():
        example = spec.example or f"{spec.name}({', '.join(spec.parameters)})"
        lines.append(f"- {example}" + (f": {spec.description}" if spec.description else ""))
    return "\n".join(lines)


def user_turn(input: AgentInput, recall: Recall, services: Services, memory_tokens: int) -> str:
    """What memory recalls (within its budget of tokens), then the observation."""
    remembered = recall.render(memory_tokens, services.llm.count_tokens) if recall.items else ""
    return f"Memory (recent steps and lessons):\n{remembered}\n\n{input.text}" if remembered else input.text


def default_answer(schema: ActionSchema) -> str:
    """How to answer, for methods that want the bare action."""
    return MENU_ANSWER if schema.choices else CALL_ANSWER


async def ask_action(
    services: Services, messages: Sequence[Message], schema: ActionSchema, purpose: str = "act", **overrides: Any
) -> tuple[Action | ActionError, LLMCall]:
    """One call that answers with the action alone: constrained to the menu, or the first line of free text."""
    if schema.choices:
        call = await services.llm.generate(purpose, messages, choices=schema.choices, **overrides)
    else:
        call = await services.llm.generate(purpose, messages, **{"stop": ("\n",), **overrides})
    return parse_action(call.text, schema), call


def last_action_line(text: str) -> str | None:
    """What follows the last ``Action:`` in ``text``; ``None`` if there is none."""
    found = _ACTION_LINE.findall(text)
    return found[-1].strip() if found else None


def sampled(call: LLMCall, completion: int = 0) -> Sampled:
    """The sampled turn of a call, token by token."""
    return Sampled.of(call.completions[completion])


class Stateless:
    """The parts of the reasoning protocol that a method without state of its own leaves empty."""

    def begin_episode(self, task: Task) -> None:
        return None

    async def observe(self, transition: Transition) -> None:
        return None

    def snapshot(self) -> bytes:
        return b""

    def restore(self, blob: bytes) -> None:
        return None
