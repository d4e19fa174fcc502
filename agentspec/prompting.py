"""What prompts are made of, and asking for one action: the same for every reasoner and reflector.

The order of a prompt is fixed, and each thing stands in it once:

    system:  instruction and rules of the environment, its actions with examples, how to answer
    turns:   the conversation so far (layout `conversation`)
    user:    lessons, what memory recalls (each within a budget of its own), a method's transcript, the observation,
             and last of all what is asked for

What is too long is cut where nothing is lost that is acted on or judged: recalled items by priority, answers of others
before their last line (`quote`), observations between actions that all stay (`course`).

An answer is read by the one tolerant reader (`agentspec.reading`). One that holds no action is asked for again, with
what was wrong with it, at most `max_retries` times; every such call is metered, counts in the call profile, and is
credited like the one that succeeds.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from agentspec.llm.base import Message, assistant, user
from agentspec.reading import Reading, read
from agentspec.registry import SpecError
from agentspec.services import Services
from agentspec.tokens import excerpt
from agentspec.types import Action, ActionError, ActionSchema, AgentInput, LLMCall, Recall, Sampled
from agentspec.visible import visible

MENU_ANSWER = "Answer with one of the listed actions, word for word."
CALL_ANSWER = "Answer with exactly one action call and nothing else."
ON_REQUEST = "What you are asked to write stands at the end of each message; write that and nothing else."
AGAIN = "No action could be read from this answer: {problem}. {how}"
TRANSCRIPT = "Transcript so far:\n{text}\n\n"
MAX_RETRIES = 2
STEPS = ("step", "failure")
"""Kinds of recalled items that do nothing but tell one of the newest steps."""

_INVENTED = re.compile(r"^\W{0,4}(?:observation|user|human|environment|action)\b", re.IGNORECASE | re.MULTILINE)

FollowUp = Callable[[Sequence[Message], Sampled, str], Sequence[Message]]
"""(prompt, what was answered, reply to it) -> the prompt of the next question."""


def static_prompt(input: AgentInput, answer: str) -> str:
    """Instruction, the actions (unless they are listed in every observation), and how to answer."""
    parts = [input.instruction.strip()]
    if not input.action_schema.choices:
        parts.append("Actions:\n" + render_actions(input.action_schema))
    parts.append(answer)
    return "\n\n".join(part for part in parts if part)


def render_actions(schema: ActionSchema) -> str:
    """One line per action: an example call and what it does."""
    lines = []
    for spec in schema.actions.values():
        example = spec.example or f"{spec.name}({', '.join(spec.parameters)})"
        lines.append(f"- {example}" + (f": {spec.description}" if spec.description else ""))
    return "\n".join(lines)


def user_turn(input: AgentInput, recall: Recall, services: Services, *, transcript: str = "", steps: int = 0) -> str:
    """Lessons and memory within the spec's budgets, a method's own transcript of the steps, then the observation.

    Steps that the transcript or the conversation tells are not told again by a memory (items of kind `step` and
    `failure`, one for each of the newest steps); of a conversation's, failures stay whose reason it does not give.

    Args:
        transcript: what a method itself tells of the newest `steps` steps.
    """
    services.context.transcript = transcript
    if transcript:
        told = [i for i, item in enumerate(recall.items) if item.kind in STEPS][-steps:]
        recall = Recall(tuple(item for i, item in enumerate(recall.items) if i not in told))
        transcript = TRANSCRIPT.format(text=transcript)
    elif services.context.told:
        recall = _untold(recall, services, input.text)
    return services.context.recalled(recall) + transcript + input.text


def _untold(recall: Recall, services: Services, observation: str) -> Recall:
    """`recall` without the newest steps that the conversation holds."""
    context = services.context
    steps = [i for i, item in enumerate(recall.items) if item.kind in STEPS]
    said = [observation, *(message.text for message in context.messages)]
    told = {
        i
        for i in steps[-context.told :]
        if recall.items[i].kind == "step" or any(failure_reason(recall.items[i].text) in text for text in said)
    }
    return Recall(tuple(item for i, item in enumerate(recall.items) if i not in told))


def failure_reason(line: str) -> str:
    """Why a step failed, from the line that tells it: `3. JUMP() -> there is no such action`."""
    return line.partition(" -> ")[2].partition("\n")[0]


def default_answer(schema: ActionSchema) -> str:
    """How to answer, for methods that want the bare action."""
    return MENU_ANSWER if schema.choices else CALL_ANSWER


def with_request(messages: Sequence[Message], request: str) -> tuple[Message, ...]:
    """`messages` with `request` at the end of the last user turn: all requests of a step share the rest."""
    return (*messages[:-1], user(f"{messages[-1].text}\n\n{request}"))


def sampled(call: LLMCall, completion: int = 0) -> Sampled:
    """The sampled turn of a call, token by token.

    Where a backend reports no token ids, nothing is lost by leaving reasoning out of later prompts, as chat models
    expect.
    """
    found = call.completions[completion]
    return Sampled.of(found) if found.token_ids else Sampled(visible(found.text)[0])


# -- cutting at the right end ---------------------------------------------------------------------------------------


def clip(text: str, budget: int, services: Services, *, keep: str = "head") -> str:
    """`text` within `budget` tokens; what is too long loses its end (`keep="head"`) or its beginning."""
    while (used := services.llm.count_tokens(text)) > budget and text:
        room = min(len(text) - 1, len(text) * max(0, budget) // used)
        text = text[:room] if keep == "head" else text[len(text) - room :]
    return text


def quote(text: str, action: Action | None, budget: int, services: Services) -> str:
    """What somebody answered, within `budget` tokens: its reasons clipped, its action always whole, on a last line."""
    shown = visible(text)[0].strip()
    if action is None:
        return clip(shown, budget, services) or "(nothing)"
    line = f"Action: {action.text}"
    before, _, after = shown.rpartition(action.text)
    reasons = (before or ("" if after != shown else shown)).rstrip(" \t\n`*\"'")
    for label in ("Action:", "action:", "ACTION:", "Action"):
        reasons = reasons.removesuffix(label).rstrip(" \t\n`*#")
    if not reasons:  # who names the action first gives the reasons after it
        reasons = _INVENTED.split(after, maxsplit=1)[0].strip(" \t\n`*\"'")
    reasons = clip(reasons, budget - services.llm.count_tokens(line) - 1, services).strip()
    return f"{reasons}\n{line}" if reasons else line


@dataclass(frozen=True)
class Step:
    """One step of a course: its action, the thought before it, and what was observed after it (empty: unknown)."""

    action: str
    thought: str = ""
    seen: str = ""


def course(steps: Sequence[Step], budget: int, services: Services) -> str:
    """Numbered steps. Every action and thought stays; what was observed shares what they leave of `budget` tokens.

    Of a long observation every paragraph is told in part, and a mark stands where it was cut.

    The newest observation gets as much as it needs of half the room, older ones equal parts of the rest.
    """
    bare = [_step(i, step, "") for i, step in enumerate(steps, 1)]
    left = budget - services.llm.count_tokens("\n".join(bare))
    shown = [""] * len(steps)
    waiting = [i for i in reversed(range(len(steps))) if steps[i].seen]
    for number, i in enumerate(waiting):
        share = left // 2 if number == 0 and len(waiting) > 1 else left // (len(waiting) - number)
        text = excerpt(steps[i].seen, share, services.llm.count_tokens) if share > 0 else ""
        shown[i] = text
        left -= services.llm.count_tokens(text)
    return "\n".join(_step(i, step, seen) for i, (step, seen) in enumerate(zip(steps, shown, strict=True), 1))


def _step(number: int, step: Step, seen: str) -> str:
    thought = f" (thought: {' '.join(step.thought.split())})" if step.thought else ""
    return f"{number}. {step.action}{thought}" + (f" -> {seen}" if seen else "")


# -- asking for an action -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Acted:
    """What came of asking for one action: how the last answer reads, its call, and all calls it took."""

    reading: Reading
    call: LLMCall
    calls: tuple[tuple[int, int], ...]

    @property
    def action(self) -> Action | ActionError:
        """The action, or why there is none."""
        return self.reading.action

    @property
    def valid(self) -> bool:
        """Whether there is an action."""
        return isinstance(self.reading.action, Action)


def read_call(call: LLMCall, schema: ActionSchema, completion: int = 0) -> Reading:
    """How an answer reads."""
    found = call.completions[completion]
    return read(found.text, schema, cut=found.finish_reason == "length")


def complaint(error: ActionError, schema: ActionSchema) -> str:
    """The reply to an answer that holds no action."""
    return AGAIN.format(problem=error.message, how=default_answer(schema))


def in_private(messages: Sequence[Message], answered: Sampled, reply: str) -> Sequence[Message]:
    """A follow-up that no later step sees."""
    return (*messages, assistant(answered), user(reply))


def in_context(services: Services) -> FollowUp:
    """Follow-ups that stay in the conversation, as they were sampled."""
    return lambda _, answered, reply: services.context.think((answered,), reply)


async def ask_action(
    services: Services,
    messages: Sequence[Message],
    schema: ActionSchema,
    purpose: str = "act",
    *,
    max_retries: int = MAX_RETRIES,
    follow_up: FollowUp | None = None,
    **sampling: Any,
) -> Acted:
    """One action: constrained to the menu where there is one, else read from a free answer; asked again if need be.

    Args:
        services: the module's.
        messages: the prompt.
        schema: the actions.
        purpose: of the calls.
        max_retries: further calls for an answer that holds no action.
        follow_up: how the prompt goes on after such an answer; by default in the conversation.
        sampling: overrides.
    """
    follow_up = follow_up or in_context(services)
    if schema.choices:
        sampling["choices"] = schema.choices
    calls: list[tuple[int, int]] = []
    while True:
        call = await services.llm.generate(purpose, messages, **sampling)
        calls.append((call.id, 0))
        reading = read_call(call, schema)
        if isinstance(reading.action, Action):
            return Acted(reading, call, tuple(calls))
        services.count("truncated" if reading.action.code == "TRUNCATED" else "malformed")
        if len(calls) > max_retries:
            return Acted(reading, call, tuple(calls))
        messages = follow_up(messages, sampled(call), complaint(reading.action, schema))


def require_variety(
    method: str, services: Services, temperature: float | None = None, *, name: str = "temperature"
) -> None:
    """Refuse to vote among answers that cannot differ.

    Raises:
        SpecError: the temperature (the parameter `name` of the method) is 0, or the model's endpoint takes none.
    """
    if temperature is None:
        temperature = services.llm.recorder.sampling.temperature
    if temperature <= 0:
        raise SpecError(
            f"{method}: {name} must be above 0, got {temperature}; greedy samples are all the same and cannot vote. "
            f"Where everything else is to be greedy, give the method its own, such as {{name: {method}, {name}: 0.7}}"
        )
    rejected = getattr(services.llm.recorder.llm, "rejected", {})
    if "temperature" in rejected:
        raise SpecError(
            f"{method} votes among samples drawn at temperature {temperature}, but {services.llm.recorder.llm.name} "
            f"does not take one ({rejected['temperature']}); choose a method of one answer (react, cot, direct), or a "
            "model whose temperature can be set"
        )
