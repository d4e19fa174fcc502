"""What tests of single memories are built from: services around a scripted model, and steps written by hand."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from agentspec.context import Context
from agentspec.embedding import HashEmbedder
from agentspec.llm.base import Request
from agentspec.llm.recorder import ModuleLLM, Recorder
from agentspec.llm.scripted import Script, ScriptedLLM
from agentspec.protocols import Services, StepClock
from agentspec.tokens import estimate_tokens
from agentspec.trajectory import Trajectory
from agentspec.types import (
    Action,
    ActionError,
    ActionSchema,
    ActionSpec,
    AgentInput,
    Decision,
    LLMCall,
    Task,
    Transition,
)

TASK = Task("agentspec-test/none-v0", 0)
SCHEMA = ActionSchema({name: ActionSpec(name) for name in ("GO", "TAKE", "WAIT")})


class Words(ScriptedLLM):
    """A scripted model that counts four characters as a token, as `estimate_tokens` does."""

    async def generate(self, request: Request) -> LLMCall:
        room = replace(request.sampling, max_tokens=request.sampling.max_tokens * 4)  # its tokens are bytes
        return await super().generate(replace(request, sampling=room))

    def count_tokens(self, text: str) -> int:
        return estimate_tokens(text)


class Asked:
    """A script that keeps what it was asked; answers by purpose, in order, the last one for ever."""

    def __init__(self, **answers: str | Sequence[str]) -> None:
        self.answers = {k: [v] if isinstance(v, str) else list(v) for k, v in answers.items()}
        self.requests: list[Request] = []

    def __call__(self, request: Request) -> str:
        self.requests.append(request)
        queue = self.answers.get(request.tag.purpose, ["no answer"])
        return queue.pop(0) if len(queue) > 1 else queue[0]

    def prompt(self, number: int = -1) -> str:
        """The text of a request."""
        return "\n".join(m.text for m in self.requests[number].messages)

    @property
    def purposes(self) -> list[str]:
        """What was asked, in order."""
        return [r.tag.purpose for r in self.requests]


def services(
    script: Script | None = None, *, embedder: Any = "hash", context: Context | None = None, name: str = "m"
) -> Services:
    """Services of `memory.<name>` around a scripted model."""
    recorder = Recorder(Words(script or (lambda request: "")), episode="e", seed=0)
    clock = StepClock()
    found = HashEmbedder() if embedder == "hash" else embedder
    llm = ModuleLLM(recorder, f"memory.{name}")
    new_id = lambda: clock.new_id(name)  # noqa: E731
    return Services(llm, context or Context("snapshot"), clock, random.Random(0), found, new_id)


def seen(text: str, instruction: str = "Deliver the parcels.") -> AgentInput:
    """u_t that shows `text`."""
    return AgentInput(instruction, text, SCHEMA)


def step(
    number: int,
    state: str,
    action: str = "WAIT()",
    *,
    message: str = "done",
    error: str = "",
    reward: float = 0.0,
    thought: str = "",
    next_text: str = "",
    ended: bool = False,
) -> Transition:
    """A step as the agent tells a memory of it."""
    chosen: Any = ActionError("BAD", error, action) if error else Action(action.split("(", maxsplit=1)[0], text=action)
    decision = Decision(chosen, rationale=thought)
    info = {"error": error, "message": message, "invalid": bool(error)}
    return Transition(number, seen(state), decision, action, reward, next_text, ended, False, info)


def episode(*transitions: Transition, **metrics: Any) -> Trajectory:
    """A finished episode."""
    return Trajectory(TASK, {}, transitions=transitions, metrics=metrics)


def learn(memory: Any, *transitions: Transition) -> None:
    """Tell a memory of steps, as the agent does: the clock stands at the step after."""
    for transition in transitions:
        memory.services.clock.step = transition.step + 1
        asyncio.run(memory.store(transition))


def recall(memory: Any, state: str, k: int | None = None) -> list[str]:
    """The texts that a memory recalls at the observation `state`."""
    return [item.text for item in asyncio.run(memory.retrieve(seen(state), k)).items]
