"""What the contract tests share: every registered module, models good and bad, and an episode that counts calls.

A module is found by being registered; nothing here names one. Modules that are written for particular environments
(``Entry.envs``) are not played in the test world.
"""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agentspec.agent import Agent
from agentspec.episode import make_env
from agentspec.llm.base import Request
from agentspec.llm.recorder import Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import REGISTRY, CallProfile, Entry
from agentspec.simulator import simulator_of
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Decision, Recall, Task, Transition
from tests.reasoning.numbers_env import NUMBERS

KINDS = ("memory", "reasoning", "reflection")
OCCASION = {
    "retrieve": "retrieve",
    "lessons": "retrieve",
    "store": "store",
    "observe": "store",
    "decide": "step",
    "revise": "step",
    "end_episode": "episode",
}


@dataclass(frozen=True)
class Case:
    """One module under one preset."""

    kind: str
    name: str
    preset: str
    entry: Entry

    @property
    def profile(self) -> CallProfile:
        return self.entry.presets[self.preset] if self.preset else self.entry.calls

    def spec(self, layout: str = "conversation", **more: Any) -> AgentSpec:
        """An agent around the module; nothing else of it calls the model more than once."""
        params = {"preset": self.preset} if self.preset else {}
        return AgentSpec.from_data(
            {
                "reasoning": "direct",
                self.kind: {"name": self.name, **params},
                "layout": layout,
                "scope": self.entry.declaration.scope or "episode",
                **more,
            }
        )

    def __str__(self) -> str:
        return f"{self.kind}-{self.name}" + (f"-{self.preset}" if self.preset else "")


def cases() -> list[Case]:
    """Every registered module that is not tied to an environment, under each of its presets."""
    return [
        Case(kind, name, preset, entry)
        for kind in KINDS
        for name, entry in sorted(REGISTRY.entries[kind].items())
        if not entry.envs
        for preset in entry.presets or [""]
    ]


class HashEmbedder:
    """Unit vectors from words by hashing: equal texts are equal, shared words are near."""

    dim = 64

    def embed(self, texts: list[str]) -> Any:
        rows = np.zeros((len(texts), self.dim), dtype=np.float32)
        for row, text in zip(rows, texts, strict=True):
            for word in text.casefold().split() or [""]:
                row[hashlib.sha256(word.encode()).digest()[0] % self.dim] += 1.0
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def lively(request: Request) -> Any:
    """Well-formed for most questions, and different from sample to sample and call to call."""
    names = ("ADD()", "DOUBLE()", "SUB()")
    if request.sampling.choices:
        return [
            request.sampling.choices[(request.seed + i) % len(request.sampling.choices)]
            for i in range(request.sampling.n)
        ]
    return [
        f"{i % 9 + 1}. Sub-goal done, likely good: {7 - i % 5}\n2. DOUBLE()\nAction: {names[(request.seed + i) % 3]}"
        for i in range(request.sampling.n)
    ]


def restless(request: Request) -> Any:
    """Never content and never finished: as many calls as a method can be brought to make."""
    if request.sampling.choices:
        return lively(request)
    if request.tag.purpose == "propose":
        names = ["ADD()", "DOUBLE()", "SUB()"]
        return [names[i % 3] for i in range(request.sampling.n)] if request.sampling.n > 1 else "\n".join(names)
    if request.tag.purpose in ("feedback", "reflect", "plan", "world"):
        return f"Not good enough yet ({request.id}). Verdict: change"
    if request.tag.purpose == "refine":
        return ("SUB()", "ADD()", "DOUBLE()")[request.id // 2 % 3]
    return "Let me think about it."


def constant(text: str) -> Any:
    """Always the same text; the first choice where the backend constrains."""
    return lambda request: request.sampling.choices[0] if request.sampling.choices else text


MALFORMED = {
    "empty": constant(""),
    "prose": constant("Well, that is a difficult question; one could do this or that."),
    "half-json": constant('{"action": "ADD(", "notes": [1, 2'),
    "10kB": constant("Action: ADD(((((" + "[1, " * 2500),
}


class Inline:
    """Runs an environment's calls at once."""

    async def call(self, what: str, function: Any) -> Any:
        return function()


class Probe:
    """A module, with the model calls of each of its methods counted."""

    def __init__(self, module: Any, recorder: Recorder, counts: dict[str, list[int]]) -> None:
        self._module, self._recorder, self._counts = module, recorder, counts

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._module, name)
        if name not in OCCASION:
            return method

        async def counted(*args: Any, **kwargs: Any) -> Any:
            before = len(self._recorder.calls)
            try:
                return await method(*args, **kwargs)
            finally:
                self._counts.setdefault(OCCASION[name], []).append(len(self._recorder.calls) - before)

        return counted


@dataclass
class Played:
    """An episode under observation."""

    agent: Agent
    recorder: Recorder
    requests: list[Request]
    counts: dict[str, list[int]] = field(default_factory=dict)
    transitions: list[Transition] = field(default_factory=list)
    recalls: list[Recall] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)

    def module(self, case: Case) -> Any:
        """The module under test, without its probe."""
        return getattr(self.agent, case.kind)._module


def start(case: Case, script: Any, *, layout: str = "conversation", menu: bool = False, **more: Any) -> Played:
    """An agent around the module, its environment reset, its episode begun; see :func:`steps`."""
    requests: list[Request] = []

    def spy(request: Request) -> Any:
        requests.append(request)
        return script(request)

    spec = case.spec(layout, **more)
    recorder = Recorder(ScriptedLLM(spy), episode="contract", seed=3, sampling=spec.sampling, budget=spec.budget)
    agent = spec.build(recorder, embedder=HashEmbedder())
    played = Played(agent, recorder, requests)
    setattr(agent, case.kind, Probe(getattr(agent, case.kind), recorder, played.counts))
    return played


def play(case: Case, script: Any, *, menu: bool = False, layout: str = "conversation", length: int = 3) -> Played:
    """A whole episode of a puzzle that cannot be solved."""
    played = start(case, script, layout=layout)
    task = Task(NUMBERS, 0, {"menu": menu, "steps": length, "target": 1000})
    for _ in steps(played, task):
        pass
    trajectory = Trajectory(task, {}, transitions=tuple(played.transitions), calls=tuple(played.recorder.calls))
    asyncio.run(played.agent.end_episode(trajectory))
    return played


def steps(played: Played, task: Task) -> Iterator[Transition]:
    """Play ``task`` step by step."""
    env, agent = make_env(task), played.agent
    observation, info = env.reset(seed=task.seed)
    agent.attach_simulator(simulator_of(env, Inline(), task, agent.perception))
    agent.begin_episode(task)
    while True:
        seen, decision = asyncio.run(agent.decide(task, observation, info))
        played.decisions.append(decision)
        text = decision.action.text
        observation, reward, terminated, truncated, info = env.step(text)
        report = {"error": info["error"], "message": info["message"], "invalid": info["invalid"]}
        step = Transition(
            len(played.transitions), seen, decision, text, reward, observation["text"], terminated, truncated, report
        )
        played.transitions.append(step)
        asyncio.run(agent.learn(step))
        yield step
        if terminated or truncated:
            return
