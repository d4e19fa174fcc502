"""A scripted expert played through a scaffold: the calls that a policy would have made, had it acted like the expert.

The environment's expert plays the tasks alone; then the scaffold plays them again with the expert's actions as answers
(`agentspec.llm.demonstration`). The environment is deterministic, so both passes agree, and the second writes the
scaffold's prompts. What a scaffold asks besides actions is answered too (`Words`): a thought names the action that
follows, and what a memory writes are the environment's notes on what was seen so far. An environment names them in the
class attribute `expert_notes`:

    class MyWorld(gymnasium.Env):
        expert_notes = "my_package.my_world.notes:notes"

A function of what was seen, newest last, `notes(inputs: Sequence[AgentInput]) -> list[str]`: one sentence each, what
matters most first. Where an environment names none, the newest observation is what is noted.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from agentspec.envs.making import environment_class
from agentspec.episode import Job, MakeEnv, Runner, make_env
from agentspec.llm.base import LLMError, Request
from agentspec.llm.demonstration import DemonstrationLLM
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec, ModuleSpec
from agentspec.tokens import CountTokens, clip_text
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Task

MOST = 6
"""Notes that one answer holds."""


def play_expert(
    spec: AgentSpec, tokenizer: Any, tasks: Sequence[Task], *, expert: str = "rule_based", make_env: MakeEnv = make_env
) -> list[Trajectory]:
    """Play `tasks` with the expert, then again inside `spec` with the expert's actions and words as answers.

    Args:
        expert: a reasoner without a model: `rule_based`, or `random`.

    Raises:
        SpecError: an episode failed, or the scaffold asks what the expert cannot answer.
    """
    jobs = [Job(task) for task in tasks]
    scripted = replace(spec, reasoning=ModuleSpec(expert), memory=ModuleSpec("none"), reflection=ModuleSpec("none"))
    played = Runner(scripted, make_env=make_env).run(jobs)
    actions = {episode.episode: [t.action_text for t in episode.transitions] for episode in played}
    llm = DemonstrationLLM(tokenizer, actions)
    llm.write = Words({episode.episode: episode for episode in played}, llm.count_tokens)
    episodes = Runner(spec, llm, make_env=make_env).run(jobs)
    failed = [t.error for t in (*played, *episodes) if not t.scorable]
    if failed:
        raise SpecError(f"{len(failed)} of {2 * len(jobs)} demonstration episodes failed, the first with: {failed[0]}")
    return episodes


def notes_of(task: Task, inputs: Sequence[AgentInput]) -> list[str]:
    """What the environment's expert would note of what was seen, what matters most first."""
    declared = getattr(environment_class(task.env), "expert_notes", "")
    if declared:
        module, _, name = declared.partition(":")
        notes: Callable[[Sequence[AgentInput]], list[str]] = getattr(import_module(module), name)
        return notes(inputs)
    return [f"Seen last: {' '.join(inputs[-1].text.split())}"] if inputs else []


# -- what a scaffold asks besides actions --------------------------------------------------------------------------


@dataclass(frozen=True)
class Words:
    """The expert's answers to everything but the action.

    Args:
        episodes: id -> the episode as the expert played it alone.
    """

    episodes: Mapping[str, Trajectory]
    count_tokens: CountTokens

    def __call__(self, request: Request) -> str:
        """The answer, within the tokens that the request allows.

        Raises:
            LLMError: nobody says how the expert answers this kind of call.
        """
        tag = request.tag
        form = FORMS.get(tag.purpose)
        if form is None or tag.episode not in self.episodes:
            raise LLMError(
                f"no demonstration for {tag.path} at step {tag.step} of episode {tag.episode}: the expert acts, and "
                f"answers calls for {', '.join(FORMS)}; leave this scaffold out"
            )
        played = self.episodes[tag.episode]
        seen = [t.input for t in played.transitions[: tag.step + 1]]
        ahead = [f"Next: {t.action_text}." for t in played.transitions[tag.step : tag.step + 1]]
        room = request.sampling.max_tokens - 1  # the end of the turn is a token too
        if form is thought:
            return clip_text(thought(ahead, request), room, self.count_tokens)
        notes = [*notes_of(played.task, seen)[: MOST - 1], *ahead]
        for most in range(len(notes), 0, -1):
            text = form(notes[:most], request)
            if self.count_tokens(text) <= room:
                return text
        text = form(notes[:1], request)
        return form([], request) if text.startswith("{") else clip_text(text, room, self.count_tokens)


def thought(notes: Sequence[str], request: Request) -> str:
    """The action that follows, in words."""
    return notes[-1] if notes else "Done."


def sentences(notes: Sequence[str], request: Request) -> str:
    """Notes as a text."""
    return " ".join(notes) or "Nothing yet."


def sheet(notes: Sequence[str], request: Request) -> str:
    """Notes as a list, between tags where the request asks for them."""
    lines = "\n".join(f"- {note}" for note in notes) or "- Nothing yet."
    tagged = "<cheatsheet>" in request.messages[-1].text
    return f"<cheatsheet>\n{lines}\n</cheatsheet>" if tagged else lines


def insights(notes: Sequence[str], request: Request) -> str:
    """Notes as the JSON that a memory of insights reads."""
    return json.dumps({"insights": list(notes[:2]), "avoid": [], "next": list(notes[2:])[-1:]})


def edits(notes: Sequence[str], request: Request) -> str:
    """Notes as rules that are written under the same names each time."""
    return json.dumps({"edits": [{"op": "add", "name": f"note {i}", "text": n} for i, n in enumerate(notes[:3], 1)]})


def rules(notes: Sequence[str], request: Request) -> str:
    """Notes as all rules there are."""
    return json.dumps({"rules": [{"name": f"note {i}", "text": n} for i, n in enumerate(notes, 1)]})


FORMS: Mapping[str, Callable[[Sequence[str], Request], str]] = {
    "think": thought,
    "argue": thought,
    "summary": sentences,
    "overview": sentences,
    "curate": sheet,
    "synthesise": sheet,
    "insight": insights,
    "learn": edits,
    "flush": sheet,
    "dream": rules,
}
"""Purpose of a call -> how the expert answers it."""
