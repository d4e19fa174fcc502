"""A language model as judge of failures: one kind per episode, out of the text that the readers of our samples read.

    python -m eval.labels [DIR] --judge MODEL [--llm KEY=VALUE ...] --to FILE

measures one on a labelled sample (`eval.labels`). A judge is asked only where somebody gives one to
`eval.failures.diagnose`, and then only of failures that no rule explains.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agentspec.failures import LEAVES
from agentspec.files import digest, read_lines, write_lines
from agentspec.llm.base import LLM, Message, Request, system, user
from agentspec.progress import duration
from agentspec.registry import SpecError
from agentspec.structured import ParseError, json_of
from agentspec.trajectory import Trajectory
from agentspec.types import CallTag, Sampling
from eval.transcripts import SURROUNDINGS, excerpt

NONE = "none"
INSTRUCTION = """You judge what went wrong in an episode that an agent played in a text world. The kinds of failure are:
{kinds}
- none: nothing went wrong, or nothing of these kinds
Choose the one kind that explains most of what went wrong. {form}"""
BY_NAME = "Answer with its name and nothing else."
BY_JSON = 'Answer with JSON only: {"kind": "<one of the names above>", "why": "<one sentence>"}'
TEMPLATE = 64
"""Tokens kept for what a chat template adds."""


@dataclass(frozen=True)
class Verdict:
    """A judge's answer.

    Args:
        text: what the model wrote.
        kind: a key of `LEAVES` or `none`; empty where the answer could not be read.
    """

    text: str
    kind: str

    @property
    def leaf(self) -> str:
        """The kind of failure, empty without one."""
        return self.kind if self.kind in LEAVES else ""


class Judge:
    """Asks a model for the kind of a failure.

    A backend that constrains its answers is asked for one of the names, which cannot be misread; any other one for
    JSON. An episode is shown as the readers saw it, cut in its middle where it is too long (`transcripts.excerpt`).

    Args:
        llm: backend.
        most_prompt: most tokens of a prompt; never more than the model's context holds.
        answer_tokens: most tokens of an answer in JSON, thinking included.

    Raises:
        ValueError: a prompt that has no room for an episode beside the instruction.
    """

    def __init__(self, llm: LLM, *, most_prompt: int = 16_000, answer_tokens: int = 1024) -> None:
        self.llm = llm
        self.choices = (*LEAVES, NONE) if {"choices", "token_ids"} <= llm.capabilities else ()
        kinds = "\n".join(f"- {name}: {what}" for name, what in LEAVES.items())
        self.instruction = INSTRUCTION.format(kinds=kinds, form=BY_NAME if self.choices else BY_JSON)
        longest = max(map(llm.count_tokens, self.choices), default=answer_tokens - 1) + 1
        self.sampling = Sampling(temperature=0.0, max_tokens=longest, choices=self.choices)
        told = llm.count_tokens(self.instruction) + TEMPLATE
        self.room = min(most_prompt, llm.max_context - longest) - told
        if self.room < 2 * TEMPLATE:
            raise ValueError(f"a prompt of {most_prompt} tokens leaves {self.room} for an episode; give {told} + 500")
        self.asked = self.unreadable = 0

    def ask(self, trajectory: Trajectory) -> str:
        """A key of `LEAVES`, or empty: no kind fits, or the answer could not be read."""
        return asyncio.run(self.judge(self.prompt(trajectory))).leaf

    def prompt(self, trajectory: Trajectory) -> tuple[Message, ...]:
        """What is asked of an episode."""
        shown = excerpt(trajectory, self.room, self.llm.count_tokens, left_out=SURROUNDINGS)
        return system(self.instruction), user(shown)

    async def judge(self, prompt: tuple[Message, ...]) -> Verdict:
        """The model's answer to a `prompt`."""
        self.asked += 1
        call = await self.llm.generate(Request(prompt, self.sampling, CallTag("eval.failures", "judge"), id=self.asked))
        found = Verdict(call.text, read_kind(call.text))
        self.unreadable += not found.kind
        return found


def read_kind(text: str) -> str:
    """The kind that an answer names, or `none`: by its JSON, else where it names exactly one; empty otherwise.

    >>> read_kind('{"kind": "grounding/spatial/stuck", "why": "..."}')
    'grounding/spatial/stuck'
    """
    try:
        kind = str(json_of({"kind": str})(text)["kind"]).strip()
    except ParseError:
        kind = text.strip()
    if kind in LEAVES or kind == NONE:
        return kind
    named = [leaf for leaf in LEAVES if leaf in text]
    return named[0] if len(named) == 1 else ""


def judged(
    judge: Judge,
    by: Mapping[str, Any],
    episodes: Mapping[str, Trajectory],
    path: str | Path,
    tell: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """What a judge says of every episode, kept in a file of labels; answers that are in it are not asked for again.

    A line is `{"episode", "labels", "answer", "judge", "prompt"}`: the kind as the only label or none, the text that
    was written, and digests of who was asked what. The file is written anew, whole, after every answer.

    Args:
        by: what makes two judges the same one.
        episodes: by number.
        path: the file; made if it is not there.
        tell: is told how long it takes.

    Raises:
        SpecError: the file holds what somebody else said, or answers to other prompts.
    """
    who = digest(json.dumps(dict(by), sort_keys=True, default=str))[:16]
    prompts = {episode: judge.prompt(t) for episode, t in episodes.items()}
    asked = {e: digest("\n\n".join(m.text for m in prompt))[:16] for e, prompt in prompts.items()}
    found = {str(line.get("episode")): line for line in read_lines(path)}
    for episode, line in found.items():
        if line.get("judge") != who or line.get("prompt") != asked.get(episode):
            raise SpecError(f"{path} holds answers of another judge, or to other prompts; choose another file")
    began, left = time.monotonic(), [e for e in episodes if e not in found]
    for number, episode in enumerate(left, 1):
        verdict = asyncio.run(judge.judge(prompts[episode]))
        labels = [verdict.leaf] if verdict.leaf else []
        line = {"episode": episode, "labels": labels, "answer": verdict.text, "judge": who, "prompt": asked[episode]}
        found[episode] = line
        write_lines(path, (found[e] for e in episodes if e in found))
        each = (time.monotonic() - began) / number
        rest = duration(each * (len(left) - number))
        tell(f"{number} of {len(left)}: {verdict.kind or 'unreadable'}; {each:.1f} s each, about {rest} left")
    return [found[e] for e in episodes]
