"""A memory on the bench: built as in an episode, told of steps one by one, its questions answered from a script."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from agentspec.agent import Agent
from agentspec.embedding import HashEmbedder
from agentspec.llm.base import Request
from agentspec.llm.recorder import Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Action, ActionSchema, AgentInput, Decision, Recall, Task, Transition

TASK = Task("bench", 0)


class Rows:
    """An embedder that looks vectors up: the first key that a text contains; the last axis for all others."""

    def __init__(self, rows: Mapping[str, Sequence[float]]) -> None:
        self.rows = {key: np.asarray(row, dtype=np.float32) for key, row in rows.items()}
        self.dim = len(next(iter(self.rows.values()))) + 1

    def embed(self, texts: Sequence[str]) -> Any:
        return np.stack([self._one(text) for text in texts])

    def _one(self, text: str) -> Any:
        row = next((row for key, row in self.rows.items() if key in text), None)
        vector = np.zeros(self.dim, dtype=np.float32)
        if row is None:
            vector[-1] = 1
            return vector
        vector[:-1] = row
        return vector / np.linalg.norm(vector)


class Bench:
    """One memory and what it asked.

    Args:
        memory: the `memory:` of a spec.
        answers: purpose -> answer, list of answers (the last one again and again), or function of the request; JSON
            values are written as JSON.
        embedder: `HashEmbedder` by default.
        spec: other fields of the spec.
    """

    def __init__(
        self, memory: Any, answers: Mapping[str, Any] | None = None, *, embedder: Any = None, **spec: Any
    ) -> None:
        self.asked: list[Request] = []
        self.answers = dict(answers or {})
        data = AgentSpec.from_data({"memory": memory, "reasoning": "direct", "layout": "snapshot", **spec})
        self.recorder = Recorder(ScriptedLLM(self._answer), episode="bench", seed=0, sampling=data.sampling)
        self.agent: Agent = data.build(self.recorder, embedder=embedder or HashEmbedder())
        self.memory: Any = self.agent.memory
        self.agent.begin_episode(TASK)
        self.transitions: list[Transition] = []

    def step(
        self,
        state: str,
        action: str = "WAIT()",
        result: str = "done",
        *,
        reward: float = 0.0,
        error: str = "",
        ended: bool = False,
    ) -> None:
        """Tell the memory of a step."""
        seen = observation(state)
        decision = Decision(Action(action.partition("(")[0], text=action))
        info = {"message": result, "error": error}
        number = len(self.transitions)
        step = Transition(number, seen, decision, action, reward, f"after {state}", ended, False, info)
        self.transitions.append(step)
        asyncio.run(self.agent.learn(step))

    def end(self, **metrics: Any) -> None:
        """End the episode and begin the next one."""
        trajectory = Trajectory(TASK, {}, transitions=tuple(self.transitions), metrics=metrics)
        asyncio.run(self.agent.end_episode(trajectory))
        self.agent.resume(self.agent.carry())
        self.agent.begin_episode(TASK)
        self.transitions = []

    def recall(self, state: str = "", k: int | None = None) -> Recall:
        """What is recalled at an observation."""
        return asyncio.run(self.memory.retrieve(observation(state), k))

    def shown(self, state: str = "") -> str:
        """The same as text."""
        return "\n".join(item.text for item in self.recall(state).items)

    def purposes(self) -> list[str]:
        """What for the memory has asked, in order."""
        return [r.tag.purpose for r in self.asked]

    def prompt(self, purpose: str, index: int = -1) -> str:
        """Text of the `index`-th question of a purpose."""
        return "\n\n".join(m.text for m in [r for r in self.asked if r.tag.purpose == purpose][index].messages)

    def problems(self) -> dict[str, int]:
        """Problems counted so far."""
        return {problem: count for (_, problem), count in self.recorder.problems.items()}

    def _answer(self, request: Request) -> str:
        self.asked.append(request)
        how = self.answers[request.tag.purpose]
        if isinstance(how, list):
            how = how.pop(0) if len(how) > 1 else how[0]
        elif isinstance(how, Callable):  # type: ignore[arg-type]
            how = how(request)
        return how if isinstance(how, str) else json.dumps(how)


def observation(state: str) -> AgentInput:
    """An observation of which only the text matters."""
    return AgentInput("Deliver food.", state, ActionSchema({}))
