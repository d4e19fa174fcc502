"""A scripted expert played through a scaffold: the calls that a policy would have made, had it acted like the expert.

The environment's expert plays the tasks alone; then the scaffold plays them again with the expert's actions as answers
(`agentspec.llm.demonstration`). The environment is deterministic, so both passes agree, and the second writes the
scaffold's prompts. What a scaffold asks besides actions is answered too (`Words`): a thought names the action that
follows, and what a memory writes are the environment's notes on what was seen so far, in the form of the example that
the memory declares for the call. An environment names its notes in the class attribute `expert_notes`:

    class MyWorld(gymnasium.Env):
        expert_notes = "my_package.my_world.notes:notes"

A function of what was seen, newest last, `notes(inputs: Sequence[AgentInput]) -> list[str]`: one sentence each, what
matters most first. Where an environment names none, the newest observation is what is noted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from agentspec.declaration import Purpose
from agentspec.envs.making import environment_class
from agentspec.episode import Job, MakeEnv, Runner, make_env
from agentspec.importing import import_name
from agentspec.llm.base import LLMError, Request
from agentspec.llm.demonstration import DemonstrationLLM
from agentspec.registry import REGISTRY, SpecError
from agentspec.reworded import reworded, without
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
    purposes = REGISTRY.get("memory", spec.memory.name).purposes
    llm.write = Words({episode.episode: episode for episode in played}, llm.count_tokens, purposes)
    episodes = Runner(spec, llm, make_env=make_env).run(jobs)
    failed = [t.error for t in (*played, *episodes) if not t.scorable]
    if failed:
        raise SpecError(f"{len(failed)} of {2 * len(jobs)} demonstration episodes failed, the first with: {failed[0]}")
    return episodes


def notes_of(task: Task, inputs: Sequence[AgentInput]) -> list[str]:
    """What the environment's expert would note of what was seen, what matters most first."""
    declared = getattr(environment_class(task.env), "expert_notes", "")
    if declared:
        notes: Callable[[Sequence[AgentInput]], list[str]] = import_name(declared)
        return notes(inputs)
    return [f"Seen last: {' '.join(inputs[-1].text.split())}"] if inputs else []


# -- what a scaffold asks besides actions --------------------------------------------------------------------------

THOUGHTS = ("think", "argue")
"""Purposes of a reasoner's calls that lead to the action, in any words."""


@dataclass(frozen=True)
class Words:
    """The expert's answers to everything but the action.

    Args:
        episodes: id -> the episode as the expert played it alone.
        purposes: what the memory's calls are for: an answer has the form of the declared example (`reworded`).
    """

    episodes: Mapping[str, Trajectory]
    count_tokens: CountTokens
    purposes: Mapping[str, Purpose]

    def __call__(self, request: Request) -> str:
        """The answer, within the tokens that the request allows.

        Raises:
            LLMError: nobody says how the expert answers this kind of call.
        """
        tag = request.tag
        remembers = tag.module.startswith("memory.") and tag.purpose in self.purposes
        if tag.episode not in self.episodes or not (remembers or tag.purpose in THOUGHTS):
            raise LLMError(
                f"no demonstration for {tag.path} at step {tag.step} of episode {tag.episode}: the expert acts, "
                "thinks aloud, and answers what the memory declares; leave this scaffold out"
            )
        played = self.episodes[tag.episode]
        seen = [t.input for t in played.transitions[: tag.step + 1]]
        ahead = [f"Next: {t.action_text}." for t in played.transitions[tag.step : tag.step + 1]]
        room = request.sampling.max_tokens - 1  # the end of the turn is a token too
        if not remembers:
            return clip_text(ahead[0] if ahead else "Done.", room, self.count_tokens)
        purpose, asked = self.purposes[tag.purpose], request.messages[-1].text
        if purpose.literal:
            return purpose.example
        example = without(purpose.example, purpose.refers)
        notes = [*notes_of(played.task, seen)[: MOST - 1], *ahead]
        for most in range(len(notes), 0, -1):
            text = reworded(example, notes[:most], asked)
            if self.count_tokens(text) <= room:
                return text
        text = reworded(example, notes[:1], asked)
        cannot_be_cut = text.startswith(("{", "["))
        return reworded(example, [], asked) if cannot_be_cut else clip_text(text, room, self.count_tokens)
