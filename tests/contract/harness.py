"""What the contract tests share: every registered module, models good and bad, and an episode that counts calls.

A module is found by its declaration; nothing here names one. Each is played under its presets, and under the small
parameters it declares, with which everything it does fires within a dozen steps. Modules that are written for
particular environments are not played in the test world.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from agentspec.agent import Agent
from agentspec.embedding import HashEmbedder
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
Script = Callable[[Request], Any]

OCCASION = {
    "retrieve": "retrieve",
    "lessons": "retrieve",
    "store": "store",
    "observe": "store",
    "decide": "step",
    "revise": "step",
    "end_episode": "episode",
}


LENGTH = 12
"""Steps of an episode in which every cadence fires."""


@dataclass(frozen=True)
class Case:
    """One module with one set of parameters: a preset, or one of the small sets that it declares."""

    kind: str
    name: str
    label: str
    params: Mapping[str, Any]
    profile: CallProfile
    entry: Entry

    @property
    def path(self) -> str:
        """The module's name in call tags."""
        return f"{self.kind}.{self.name}"

    @property
    def affordable(self) -> bool:
        """Whether a dozen steps cost few calls."""
        return self.label != "paper"

    def spec(self, layout: str = "conversation", **more: Any) -> AgentSpec:
        """An agent around the module; nothing else of it calls the model more than once."""
        module = {"name": self.name, **self.params}
        scope = self.entry.declaration.scope or "episode"
        return AgentSpec.from_data({"reasoning": "direct", self.kind: module, "layout": layout, "scope": scope, **more})

    def __str__(self) -> str:
        return f"{self.kind}-{self.name}" + (f"-{self.label}" if self.label else "")


def cases(kinds: tuple[str, ...] = KINDS) -> list[Case]:
    """Every module of this package that is not tied to an environment, with each set of parameters.

    Memories of libraries are not among them (`tests/memory/test_libraries.py` says what they keep to).
    """
    found = []
    for kind in kinds:
        for name, entry in REGISTRY.all(kind).items():
            library = bool(entry.declaration.extra)
            if not entry.scripted and not library and entry.target.startswith("agentspec."):
                found += variants(kind, name, entry)
    return found


def variants(kind: str, name: str, entry: Entry) -> list[Case]:
    """A module with each of its presets (or its defaults), and with each small set of parameters."""
    declared = entry.declaration
    found = [Case(kind, name, p, {"preset": p}, profile, entry) for p, profile in entry.presets.items()]
    found = found or [Case(kind, name, "", {}, entry.calls, entry)]
    profile = declared.small_calls or entry.calls
    return found + [Case(kind, name, f"small{i}", p, profile, entry) for i, p in enumerate(declared.small)]


def affordable(kinds: tuple[str, ...] = KINDS) -> list[Case]:
    """The cases of which a whole episode can be played."""
    return [case for case in cases(kinds) if case.affordable]


def example(case: Case) -> Script:
    """The answers that the module declares as well-formed; `lively` ones where any text will do."""

    def script(request: Request) -> Any:
        text = _example(case, request)
        return [text] * request.sampling.n if text and not request.sampling.choices else lively(request)

    return script


def wrongly_typed(case: Case) -> Script:
    """JSON of the declared examples with every value of another type, in turn with JSON that is none of them."""

    def script(request: Request) -> Any:
        if request.sampling.choices:
            return lively(request)
        text = _example(case, request)
        try:
            data = json.loads(text)
        except ValueError:
            return '{"unexpected": [1, {"text": null}]}'
        turns = (_mistyped(data), [data], {"answer": data}, None, 7, [], {})
        return json.dumps(turns[request.id % len(turns)])

    return script


def _example(case: Case, request: Request) -> str:
    purpose = case.entry.purposes.get(request.tag.purpose) if request.tag.module == case.path else None
    return purpose.example if purpose else ""


def _mistyped(data: Any) -> Any:
    """Every leaf as a value of another type."""
    if isinstance(data, dict):
        return {key: _mistyped(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_mistyped(value) for value in data] or "empty"
    return 3.5 if isinstance(data, str) else {"value": str(data)}


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


def scripts(case: Case) -> dict[str, Script]:
    """Models good and bad."""
    return {
        "lively": lively,
        "restless": restless,
        "example": example(case),
        "wrongly-typed": wrongly_typed(case),
        **MALFORMED,
    }


SCRIPTS = ("lively", "restless", "example", "wrongly-typed", *MALFORMED)


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


def start(case: Case, script: Any, *, layout: str = "conversation", **more: Any) -> Played:
    """An agent around the module, its environment reset, its episode begun; see :func:`steps`."""
    requests: list[Request] = []

    def spy(request: Request) -> Any:
        requests.append(request)
        return script(request)

    spec = case.spec(layout, **{"scope": "run", **more})
    recorder = Recorder(ScriptedLLM(spy), episode="contract", seed=3, sampling=spec.sampling, budget=spec.budget)
    agent = spec.build(recorder, embedder=HashEmbedder())
    played = Played(agent, recorder, requests)
    setattr(agent, case.kind, Probe(getattr(agent, case.kind), recorder, played.counts))
    return played


def play(
    case: Case,
    script: Any,
    *,
    menu: bool = False,
    layout: str = "conversation",
    length: int = 3,
    carried: bytes | None = None,
) -> Played:
    """A whole episode of a puzzle that cannot be solved, from an empty memory or from what an earlier one carried."""
    played = start(case, script, layout=layout)
    if carried is not None:
        played.agent.resume(carried)
    task = Task(NUMBERS, 0, {"menu": menu, "steps": length, "target": 1000})
    for _ in steps(played, task):
        pass
    trajectory = Trajectory(task, {}, transitions=tuple(played.transitions), calls=tuple(played.recorder.calls))
    asyncio.run(played.agent.end_episode(trajectory))
    return played


def begin(played: Played, task: Task) -> tuple[Any, Any, dict[str, Any]]:
    """Reset the environment of ``task`` and begin the agent's episode in it."""
    env, agent = make_env(task), played.agent
    observation, info = env.reset(seed=task.seed)
    agent.attach_simulator(simulator_of(env, Inline(), task, agent.perception))
    agent.begin_episode(task)
    return env, observation, info


def steps(played: Played, task: Task) -> Iterator[Transition]:
    """Play ``task`` step by step."""
    agent = played.agent
    env, observation, info = begin(played, task)
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
