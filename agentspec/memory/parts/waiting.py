"""Steps that wait to become notes, and how they are told to who makes notes of them.

A memory that asks the model about several steps holds them as `Step`s until they are notes; what is left over at an
episode's end is asked about when the next episode of the run begins, so that no call is made that no action can profit
from, and what is asked is paid for by the episode that reads it. How the episode ended is told with what is left over;
where nothing is, it becomes a note as it is (`result`), and no call is made for it alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from agentspec.memory.parts.entries import numbers, one_line, stamp
from agentspec.memory.parts.telling import STEPS, outcome
from agentspec.protocols import Services
from agentspec.services import Time
from agentspec.state import Record
from agentspec.tokens import clip_text
from agentspec.trajectory import Trajectory
from agentspec.types import Experience, Transition

CONCLUDE = "An episode has ended among these steps: say also what led to its result, good or bad."


@dataclass(frozen=True)
class Step(Record):
    """A step that waits to become notes: when it was, told in full, and in one line; each within a budget.

    How an episode ended waits among its steps, told in full and without a line (`ends`).
    """

    time: Time
    text: str
    line: str

    @classmethod
    def of(cls, transition: Transition, services: Services, tokens: int) -> Step:
        """The step of a transition that has just been made; its text and its line have at most `tokens` each."""
        now = services.time()
        time = Time(now.episode, transition.step, max(0, now.total - now.step + transition.step))
        seen = Experience.of(transition)
        count = services.llm.count_tokens
        return cls(time, seen.block(tokens, count), clip_text(one_line(seen.line()), tokens, count))

    @classmethod
    def end(cls, trajectory: Trajectory, services: Services) -> Step:
        """How an episode ended, at its last step."""
        now, last = services.time(), max(0, len(trajectory.transitions) - 1)
        return cls(Time(now.episode, last, max(0, now.total - now.step + last)), outcome(trajectory), "")

    @property
    def ends(self) -> bool:
        """Whether this says how an episode ended."""
        return not self.line

    def row(self) -> list[Any]:
        return [numbers(self.time), self.text, self.line]

    @classmethod
    def load(cls, state: Sequence[Any]) -> Step:
        """What `row` gave."""
        return cls(Time(*state[0]), state[1], state[2])


def told(steps: Iterable[Step]) -> str:
    """Steps one after the other, each under its time; where an episode ends among them, what that asks for."""
    kept = list(steps)
    blocks = [f"[{stamp(s.time, kept[-1].time)}]\n{s.text}" for s in kept]
    return "\n\n".join([*blocks, *concluding(kept)])


def concluding(steps: Iterable[Step]) -> list[str]:
    """What is asked for beside the notes of the steps: what led to a result, where one is among them."""
    return [CONCLUDE] if any(s.ends for s in steps) else []


def result(end: Step) -> str:
    """How an episode ended, where it stands by itself: no step that led to it waits any more."""
    return f"Episode {end.time.episode + 1}: {end.text}"


def unwritten(steps: Iterable[Step]) -> bool:
    """Whether there are steps to make notes of; how an episode ended is none by itself."""
    return any(not s.ends for s in steps)


def task_of(instruction: str, tokens: int, services: Services) -> str:
    """The beginning of the task's instruction on one line."""
    return clip_text(" ".join(instruction.split()), tokens, services.llm.count_tokens) or "(not told)"


def shown_lines(lines: Sequence[str], most: int) -> list[str]:
    """The newest lines; those of steps that the prompt tells anyway are left out there (`agentspec.prompting`)."""
    return list(lines)[-most:] if most else []


__all__ = ["CONCLUDE", "STEPS", "Step", "concluding", "result", "shown_lines", "task_of", "told", "unwritten"]
