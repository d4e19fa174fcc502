"""A scripted model that plays the number puzzle by its rules, and a way to play episodes with it.

Asked for an action it is greedy, so ``direct`` fails. Asked to judge, to predict, to plan or to criticise it is right:
the methods must make something of that.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from agentspec.episode import Job, Runner
from agentspec.llm.base import Message, Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.reasoning.numbers_env import MENU, NUMBERS, OPERATIONS, greedy, solve

Script = Callable[[Request], Any]


def seen(text: str) -> tuple[int, int, int]:
    """(number, target, steps left) as last observed in ``text``."""
    number, target, left = re.findall(
        r"The number is (-?\d+)\. The target is (-?\d+)\. There are (-?\d+) steps left", text
    )[-1]
    return int(number), int(target), int(left)


def named(name: str, request: Request) -> str:
    """The operation as this request wants it: a menu entry or a call."""
    return MENU[name] if MENU[name] in request.sampling.choices else f"{name}()"


def operations(text: str) -> list[str]:
    """Operations named in ``text``, calls or menu entries, in order."""
    names = {f"{name}()": name for name in OPERATIONS} | {entry: name for name, entry in MENU.items()}
    folded = {written.casefold(): name for written, name in names.items()}
    return [folded[m] for m in re.findall("|".join(re.escape(n) for n in folded), text.casefold())]


def last(request: Request) -> str:
    return request.messages[-1].text


def greedy_player(request: Request) -> str:
    """Answers every question for an action with the greedy one."""
    number, target, _ = seen("\n".join(m.text for m in request.messages if m.role == "user"))
    return named(greedy(number, target), request)


def play(
    script: Script,
    spec: dict[str, Any],
    *,
    env: str = NUMBERS,
    score: Callable[[Sequence[Message], str], float] | None = None,
    jobs: int = 1,
    **options: Any,
) -> tuple[Trajectory, list[Request]]:
    """One episode of the puzzle (``jobs`` > 1: a chain of trials, the last one returned), and the requests it made."""
    requests: list[Request] = []

    def spy(request: Request) -> Any:
        requests.append(request)
        return script(request)

    runner = Runner(AgentSpec.from_data(spec), ScriptedLLM(spy, score=score))
    state = None
    for trial in range(jobs):
        (trajectory,) = runner.run([Job(Task(env, 0, options), run_seed=trial, memory_state=state)])
        state = trajectory.memory_state
    return trajectory, requests


def solved(trajectory: Trajectory) -> bool:
    return bool(trajectory.metrics["success"])


def purposes(requests: Sequence[Request]) -> list[str]:
    return [r.tag.purpose for r in requests]


def credits_of(trajectory: Trajectory, purpose: str) -> list[str]:
    return [c.credit for call in trajectory.calls if call.tag.purpose == purpose for c in call.completions]


__all__ = [
    "OPERATIONS",
    "credits_of",
    "greedy_player",
    "last",
    "named",
    "operations",
    "play",
    "purposes",
    "seen",
    "solve",
    "solved",
]
