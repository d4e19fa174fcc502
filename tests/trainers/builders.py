"""Small exact episodes for tests of the trainers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from agentspec.trajectory import Trajectory
from agentspec.types import Action as Act
from agentspec.types import (
    ActionSchema,
    AgentInput,
    CallTag,
    Completion,
    Decision,
    LLMCall,
    Sampling,
    Task,
    Transition,
)

CPU_RUN: dict[str, Any] = {
    "learning_rate": 1e-2,
    "optim": "adamw_torch",
    "report_to": [],
    "use_cpu": True,
    "bf16": False,
    "gradient_checkpointing": False,
    "logging_steps": 1,
    "disable_tqdm": True,
}
"""Settings of a short, silent run on a CPU, as tests of the trainers make them."""


def call(
    id: int,
    prompt: list[int],
    sampled: list[int],
    *,
    module: str = "reasoning.direct",
    purpose: str = "act",
    credit: str = "executed",
    logprobs: list[float] | None = None,
    allowed: tuple[tuple[int, ...] | None, ...] = (),
    temperature: float = 1.0,
    step: int = 0,
) -> LLMCall:
    completion = Completion(
        "x",
        tuple(sampled),
        tuple(logprobs or [-1.0] * len(sampled)),
        allowed,
        "stop",
        credit,  # type: ignore[arg-type]
    )
    return LLMCall(
        id, CallTag(module, purpose, "e", step), tuple(prompt), (completion,), Sampling(temperature=temperature)
    )


def episode(calls: list[LLMCall], rewards: Sequence[float] = (0.0,), *, status: str = "completed", rollout: int = 0):
    balance, transitions = 100.0, []
    for i, reward in enumerate(rewards):
        before = balance
        balance += reward
        transitions.append(
            Transition(
                i,
                AgentInput("go", f"t{i}", ActionSchema({}), {"balance": before}),
                Decision(Act("A", text="A()")),
                "A()",
                reward,
                f"t{i + 1}",
                terminated=i == len(rewards) - 1,
                info={"balance": balance},
            )
        )
    return Trajectory(Task("toy", 0), {}, rollout, transitions=tuple(transitions), calls=tuple(calls), status=status)


def instead_of_playing(build: Callable[[Any], Sequence[Trajectory]]) -> Callable[..., Any]:
    """What a trainer plays with (`trainers.rollouts.collect`), giving episodes that were built: jobs -> episodes."""
    from trainers.credit import ScoredEpisode

    return lambda runner, jobs, rewards, **_: [ScoredEpisode(t, rewards.score(t)) for t in build(jobs)]
