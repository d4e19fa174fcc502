"""Where a search gets its next actions from: samples of the policy, the same ones merged.

Of several samples those without an action are proposals fewer: a search samples many to have some. If none of them
holds one, they are asked for again with what was wrong, within the decision's retries.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from agentspec.actions import canonical, parse_action
from agentspec.llm.base import Message, assistant, user
from agentspec.prompting import MENU_ANSWER, sampled, with_request
from agentspec.reading import labelled, read
from agentspec.reasoning.search.meter import Ask, Meter, Unread, ask_again
from agentspec.types import Action, ActionSchema, LLMCall
from agentspec.values import takes_lines
from agentspec.visible import visible

MAX_LINE = 200
"""Characters of a step that is only imagined: a longer line is no action."""

MAX_LINES = 200
"""Lines of a list of proposals that are read."""

_BULLET = re.compile(r"^\s*(?:[-*•]|\(?\d+[.):])\s*")


@dataclass(frozen=True)
class Proposal:
    """A candidate: its text, how many samples proposed it, the first of them, and the thought before it.

    `before` is the completion of the thought where it was a call of its own.
    """

    text: str
    count: int
    source: tuple[int, int]
    thought: str = ""
    before: tuple[tuple[int, int], ...] = ()


def read_step(
    text: str, schema: ActionSchema, *, imagined: bool, cut: bool = False
) -> tuple[str, Hashable, str] | None:
    """The action in an answer, what identifies it, and the thought before it; `None` if there is none.

    In an `imagined` state of a menu environment nobody knows the menu, so any short line counts as a step there; it is
    never executed. A known action call is always read as such.
    """
    reading = read(text, schema, cut=cut)
    if isinstance(reading.action, Action):
        return reading.action.text, canonical(reading.action, schema), reading.thought
    if imagined and schema.choices:
        shown = re.split(r"(?im)^\W*action\W*:", visible(text)[0])
        line = next((part.strip(" \t*`\"'") for part in shown[-1].splitlines() if part.strip(" \t*`\"'")), "")
        if line and len(line) <= MAX_LINE:
            return line, " ".join(line.casefold().split()), shown[0].strip() if len(shown) > 1 else ""
    return None


def read_steps(text: str, schema: ActionSchema, *, imagined: bool) -> list[str]:
    """The steps listed in `text`, one a line in whatever dress, equal ones once.

    Lines with an `Action:` label count alone where there are any. An answer that is no list of lines may still be one
    action (JSON, a label and its call on the next line).
    """
    whole = read_step(text, schema, imagined=imagined)
    if whole is not None and takes_lines(text):
        return [whole[0]]
    found: dict[Hashable, str] = {}
    lines = [line for line in visible(text)[0].splitlines() if line.strip()][:MAX_LINES]
    for line in [line for line in lines if labelled(line)] or lines:
        bare = _BULLET.sub("", line, count=1)
        step = read_step(bare, schema, imagined=imagined) if bare.strip("` \t") else None
        if step is not None:
            found.setdefault(step[1], step[0])
    return list(found.values()) or ([whole[0]] if whole is not None else [])


async def sample_steps(
    meter: Meter,
    messages: Sequence[Message],
    schema: ActionSchema,
    request: str,
    *,
    n: int,
    imagined: bool,
    **sampling: Any,
) -> list[Proposal]:
    """`n` samples of the next action in one request, equal ones merged, in the order they first came.

    Decoding is constrained to the menu where there is one and the state is not an `imagined` one. Every sample is
    credited `explored`; whoever executes one credits it anew.
    """
    choices = {"choices": schema.choices} if schema.choices and not imagined else {}
    ask = Ask("propose", with_request(messages, request), {"n": n, **choices, **sampling}, "explored")
    calls = await meter.ask_all([ask])
    meter.stop()

    def proposals(call: LLMCall) -> list[Proposal]:
        return merge(call, schema, imagined=imagined)

    return proposals(await readable(meter, ask, calls[0], schema, proposals))


async def readable(
    meter: Meter, ask: Ask, call: LLMCall, schema: ActionSchema, proposals: Callable[[LLMCall], Sequence[Any]]
) -> LLMCall:
    """`call`, or if it holds no `proposals`, the answer to the question asked again (`call` if there is none)."""
    if proposals(call):
        return call
    (again,) = await ask_again(meter, [Unread(ask, call)], schema, lambda answer: bool(proposals(answer)))
    return call if again is None else again[0]


async def think_and_choose(
    meter: Meter,
    messages: Sequence[Message],
    schema: ActionSchema,
    request: str,
    *,
    n: int,
    temperature: float,
    **limit: Any,
) -> list[Proposal]:
    """`n` thoughts as samples of one request, and after each of them one entry of the menu; equal entries merged.

    Args:
        meter: of the decision.
        messages: the step's prompt.
        schema: with the menu's choices.
        request: asks for the thought.
        n: samples.
        temperature: of thoughts and choices.
        limit: sampling overrides of the thoughts.
    """
    asked = with_request(messages, request)
    thoughts = await meter.ask("think", asked, "explored", n=n, temperature=temperature, **limit)
    choices = {"choices": schema.choices, "temperature": temperature}
    asks = [
        Ask("propose", (*asked, assistant(sampled(thoughts, i)), user(MENU_ANSWER)), choices, "explored")
        for i in range(len(thoughts.completions))
    ]

    def chosen(call: LLMCall) -> list[Proposal]:
        return merge(call, schema, imagined=False)

    found: dict[Hashable, Proposal] = {}
    for i, (ask, call) in enumerate(zip(asks, await meter.ask_all(asks), strict=False)):
        for proposal in chosen(await readable(meter, ask, call, schema, chosen)):
            said = " ".join(visible(thoughts.completions[i].text)[0].split())
            known = found.get(proposal.text)
            found[proposal.text] = (
                replace(proposal, thought=said, before=((thoughts.id, i),))
                if known is None
                else replace(known, count=known.count + 1)
            )
    meter.stop()
    return list(found.values())


def merge(call: LLMCall, schema: ActionSchema, *, imagined: bool) -> list[Proposal]:
    """The samples of `call` as proposals."""
    found: dict[Hashable, Proposal] = {}
    for i, completion in enumerate(call.completions):
        step = read_step(completion.text, schema, imagined=imagined, cut=completion.finish_reason == "length")
        if step is None:
            continue
        known = found.get(step[1])
        thought = step[2]
        found[step[1]] = (
            Proposal(step[0], 1, (call.id, i), thought)
            if known is None
            else Proposal(known.text, known.count + 1, known.source, known.thought)
        )
    return list(found.values())


def legal(text: str, schema: ActionSchema) -> Action | None:
    """`text` as an action of `schema`."""
    action = parse_action(text, schema)
    return action if isinstance(action, Action) else None
