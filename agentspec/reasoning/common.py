"""What all reasoners share: the static prompt, the user turn, and asking for one action.

Static text (instruction, actions, how to answer) goes first and is the same at every step of a task; recalled memory
and the observation follow. In menu mode the answer is decoded under the constraint of the listed actions; otherwise
it is free text that the parser reads.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from typing import Any

from agentspec.actions import parse_action
from agentspec.llm.base import Message, user
from agentspec.parameters import at_least, one_of, settings
from agentspec.protocols import Services
from agentspec.types import Action, ActionError, ActionSchema, AgentInput, LLMCall, Recall, Sampled, Task, Transition

__all__ = ["at_least", "one_of", "settings"]

MENU_ANSWER = "Answer with one of the listed actions, word for word."
CALL_ANSWER = "Answer with exactly one action call and nothing else."
ON_REQUEST = "What you are asked to write stands at the end of each message; write that and nothing else."

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


def user_turn(input: AgentInput, recall: Recall, services: Services) -> str:
    """What memory recalls (within the spec's budgets of tokens), then the observation."""
    return services.context.recalled(recall) + input.text


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


def read_action(text: str, schema: ActionSchema) -> Action | ActionError:
    """The action of a free answer: what follows its last ``Action:``, or the answer itself if it has no such line."""
    line = last_action_line(text)
    return parse_action(text if line is None else line, schema)


def canonical(action: Action, schema: ActionSchema) -> Hashable:
    """Equal for actions that mean the same, however they were written: the name, and the arguments by parameter."""
    spec = schema.actions.get(action.name)
    names = list(spec.parameters) if spec else []
    arguments: dict[str, Any] = {str(names[i] if i < len(names) else i): a for i, a in enumerate(action.args)}
    return (action.name.casefold(), repr(sorted({**arguments, **action.kwargs}.items())))


def with_request(messages: Sequence[Message], request: str) -> tuple[Message, ...]:
    """``messages`` with ``request`` at the end of the last user turn: all requests of a step share the rest."""
    return (*messages[:-1], user(f"{messages[-1].text}\n\n{request}"))


def clip(text: str, budget: int, services: Services, *, keep: str = "head") -> str:
    """``text`` within ``budget`` tokens; what is too long loses its end (``keep="head"``) or its beginning."""
    while (used := services.llm.count_tokens(text)) > budget and text:
        room = min(len(text) - 1, len(text) * budget // used)
        text = text[:room] if keep == "head" else text[len(text) - room :]
    return text


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
