"""Where a search gets its next actions from: samples of the policy, the same ones merged."""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

from agentspec.actions import parse_action
from agentspec.llm.base import Message
from agentspec.reasoning.common import canonical, last_action_line, read_action, with_request
from agentspec.reasoning.search.meter import Meter
from agentspec.types import Action, ActionSchema, LLMCall

MAX_LINE = 200
"""Characters of a step that is only imagined: a longer line is no action."""

_BULLET = re.compile(r"^\s*(?:[-*•]|\(?\d+[.):])\s*")


@dataclass(frozen=True)
class Proposal:
    """A candidate: its text, how many samples proposed it, the first of them, and the thought before it."""

    text: str
    count: int
    source: tuple[int, int]
    thought: str = ""


def read_step(text: str, schema: ActionSchema, *, imagined: bool) -> tuple[str, Hashable] | None:
    """The action in a piece of free text and what identifies it, or ``None``.

    In an ``imagined`` state of a menu environment nobody knows the menu, so any short line counts as a step there; it
    is never executed. A known action call is always read as such.
    """
    action = read_action(text, schema)
    if isinstance(action, Action):
        return action.text, canonical(action, schema)
    line = last_action_line(text) or next((part.strip() for part in text.splitlines() if part.strip()), "")
    if imagined and schema.choices and line and len(line) <= MAX_LINE:
        return line, " ".join(line.casefold().split())
    return None


def read_steps(text: str, schema: ActionSchema, *, imagined: bool) -> list[str]:
    """The steps listed in ``text``, one a line, numbers and bullets dropped, equal ones once."""
    found: dict[Hashable, str] = {}
    for line in text.splitlines():
        bare = _BULLET.sub("", line, count=1)
        step = read_step(bare, schema, imagined=imagined) if bare.strip() else None
        if step is not None:
            found.setdefault(step[1], step[0])
    return list(found.values())


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
    """``n`` samples of the next action in one request, equal ones merged, in the order they first came.

    Decoding is constrained to the menu where there is one and the state is not an ``imagined`` one. Every sample is
    credited ``explored``; whoever executes one credits it anew.
    """
    if schema.choices and not imagined:
        call = await meter.ask(
            "propose", with_request(messages, request), "explored", n=n, choices=schema.choices, **sampling
        )
        return merge(call, schema, imagined=False)
    call = await meter.ask("propose", with_request(messages, request), "explored", n=n, **sampling)
    return merge(call, schema, imagined=imagined)


def merge(call: LLMCall, schema: ActionSchema, *, imagined: bool) -> list[Proposal]:
    """The samples of ``call`` as proposals."""
    found: dict[Hashable, Proposal] = {}
    for i, completion in enumerate(call.completions):
        step = read_step(completion.text, schema, imagined=imagined)
        if step is None:
            continue
        known = found.get(step[1])
        thought = completion.text if last_action_line(completion.text) else ""
        found[step[1]] = (
            Proposal(step[0], 1, (call.id, i), thought)
            if known is None
            else Proposal(known.text, known.count + 1, known.source, known.thought)
        )
    return list(found.values())


def legal(text: str, schema: ActionSchema) -> Action | None:
    """``text`` as an action of ``schema``."""
    action = parse_action(text, schema)
    return action if isinstance(action, Action) else None
