"""Memories of libraries beside their native counterparts; each is skipped where its library is not installed.

The same walk is played through both, with the same scripted model behind them: it answers what a library asks by the
example that the purpose declares, its sentences replaced by those of the world that stand in that very prompt.
"""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import socket
from collections.abc import Callable
from typing import Any

import pytest

from agentspec.agent import Agent
from agentspec.episode import Job, Runner
from agentspec.llm.base import LLMError, Request
from agentspec.llm.recorder import Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.memory.libraries import GraphitiLibrary, LangMemLibrary, Mem0Library
from agentspec.memory.libraries.base import TELEMETRY
from agentspec.registry import REGISTRY, SpecError
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Recall, Task
from tests.memory.recall_world import RECALL, Reader, fact_of, notes, walk

LIBRARIES: dict[Any, dict[str, Any]] = {
    LangMemLibrary: {"name": "langmem"},
    Mem0Library: {"name": "mem0"},
    GraphitiLibrary: {"name": "zep", "least": 0.0},  # hashed vectors are seldom as near as its 0.6
}
"""The library's class -> its native counterpart."""


def extract(request: Request) -> str:
    """Of `zep`, whose declared examples name the same things again and contradict what is known of them."""
    told = enumerate(notes(request))
    return json.dumps(
        {"facts": [{"subject": f"thing {i}", "relation": "is", "object": "", "fact": n} for i, n in told]}
    )


ZEP = {"extract": extract, "same": '{"same": []}', "resolve": '{"results": []}', "community": "A town."}

DELAY = 6


def _case(cls: Any) -> Any:
    installed = importlib.util.find_spec(cls.package) is not None
    reason = f"{cls.package} is not installed: pip install 'agentspec-rl[{cls.declaration.extra}]'"
    return pytest.param(cls, marks=pytest.mark.skipif(not installed, reason=reason), id=cls.name)


each_library = pytest.mark.parametrize("cls", [_case(cls) for cls in LIBRARIES])


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Nothing is looked up or connected to, by whatever thread."""
    tried: list[Any] = []

    def refuse(*args: Any, **more: Any) -> Any:
        tried.append(args)
        raise OSError("no network in this test")

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket.socket, "connect_ex", refuse)
    yield
    assert not tried


def spent(trajectories: list[Trajectory], name: str) -> tuple[int, int, int]:
    """Calls of a memory, tokens they read, tokens they wrote."""
    calls = [c for t in trajectories for c in t.calls if c.tag.module == f"memory.{name}"]
    return len(calls), sum(c.usage.input_tokens for c in calls), sum(c.usage.output_tokens for c in calls)


@each_library
def test_it_recalls_what_its_native_counterpart_recalls(cls: Any, record_property: Callable[[str, Any], None]) -> None:
    native, name = LIBRARIES[cls], cls.name
    for seed in (0, 1):
        played = {
            memory["name"]: walk({**memory, "every": 2}, scope="run", delay=DELAY, seed=seed, curate=curate)
            for memory, curate in ((native, ZEP if cls is GraphitiLibrary else None), ({"name": name}, None))
        }
        for memory, (trajectories, reader) in played.items():
            # The question is asked in another episode than the notice was seen in: it can only come from memory.
            question = next(r for r in reversed(reader.asked) if not r.tag.module.startswith("memory."))
            told = "\n".join(m.text for m in question.messages)
            assert fact_of(seed)[1] in told, f"{memory} did not recall it"
            assert trajectories[-1].metrics["success"] == 1.0
            figures = dict(zip(("calls", "tokens in", "tokens out"), spent(trajectories, memory), strict=True))
            record_property(f"{memory} {seed}", figures)
            print(f"{memory}, seed {seed}: {figures}")
        trajectories, _ = played[name]
        calls = [c for t in trajectories for c in t.calls if c.tag.module.startswith("memory.")]
        assert {c.tag.path for c in calls} <= {f"memory.{name}/{p}" for p in cls.declaration.purposes}
        # Steps 2, 4 and 6 of each episode are written after; of the first, the last two after its end.
        assert {c.tag.step for c in calls if c.tag.episode == calls[0].tag.episode} == {2, 4, 6}
        assert len(calls) >= DELAY and all(t.metrics.get("memory/failures", 0) == 0 for t in trajectories)


def built(cls: Any, llm: Any = None, scope: str = "run") -> Agent:
    spec = AgentSpec.from_data({"memory": cls.name, "scope": scope, "embedder": "hash", "layout": "snapshot"})
    return spec.build(Recorder(llm or Reader(), episode="e", seed=0))


@each_library
def test_its_state_is_exported_and_read_again(cls: Any) -> None:
    trajectories, _ = walk(cls.name, scope="run", delay=DELAY)
    state, seen = trajectories[0].memory_state, trajectories[-1].transitions[-1].input
    assert state is not None
    first, second = built(cls), built(cls)
    first.resume(state)
    blob = first.memory.snapshot()
    second.memory.restore(blob)
    assert second.memory.snapshot() == blob
    recalls: list[Recall] = [asyncio.run(agent.memory.retrieve(seen)) for agent in (first, second)]
    assert [i.text for i in recalls[0].items] == [i.text for i in recalls[1].items]
    assert any(fact_of(0)[1] in item.text for item in recalls[0].items)
    # What one learns, the other does not know.
    for transition in trajectories[-1].transitions[:2]:
        asyncio.run(second.memory.store(transition))
    assert second.memory.snapshot() != blob and first.memory.snapshot() == blob


@each_library
@pytest.mark.parametrize("answer", ["", "I cannot say.", '{"facts": 3, "calls": "none", "edges": [7]}'])
def test_answers_that_cannot_be_read_write_nothing(cls: Any, answer: str) -> None:
    curate = {purpose: answer for purpose in cls.declaration.purposes}
    [trajectory], reader = walk(cls.name, delay=3, curate=curate)
    assert trajectory.status == "completed", trajectory.error
    asked = [r for r in reader.asked if r.tag.module.startswith("memory.")]
    assert len(asked) >= 3 and trajectory.metrics["success"] == 0.0
    if cls is GraphitiLibrary:  # it raises at such answers; they are counted
        assert trajectory.metrics["memory/failures"] >= 3 and trajectory.metrics["memory/problems/library"] >= 3
    else:
        assert trajectory.metrics["memory/entries"] == 0


@each_library
def test_what_the_backend_raises_is_not_swallowed(cls: Any) -> None:
    def down(request: Request) -> str:
        if request.tag.module.startswith("memory."):
            raise LLMError("the server is down")
        return "WALK()"

    spec = AgentSpec.from_data({"memory": cls.name, "embedder": "hash", "layout": "snapshot"})
    [trajectory] = Runner(spec, ScriptedLLM(down)).run([Job(Task(RECALL, 0, {"delay": 3}))])
    assert trajectory.status == "failed" and "the server is down" in trajectory.error


@each_library
def test_several_episodes_at_once_keep_apart(cls: Any) -> None:
    spec = AgentSpec.from_data({"memory": cls.name, "embedder": "hash", "layout": "snapshot", "reasoning": "direct"})
    jobs = [Job(Task(RECALL, seed, {"delay": DELAY})) for seed in range(3)]
    for trajectory in Runner(spec, Reader()).run(jobs):
        assert trajectory.status == "completed", trajectory.error
        assert trajectory.metrics["success"] == 1.0 and trajectory.metrics["memory/failures"] == 0
    assert all(os.environ[name] == value for name, value in TELEMETRY.items())


@pytest.mark.parametrize("cls", list(LIBRARIES), ids=lambda cls: cls.name)
def test_without_its_library_the_spec_is_refused(cls: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, p=None: None if n == cls.package else find(n, p))
    with pytest.raises(SpecError) as error:
        AgentSpec.from_data({"memory": cls.name, "embedder": "hash"})
    assert "\n" not in str(error.value)
    assert f"pip install 'agentspec-rl[{cls.declaration.extra}]'" in str(error.value)
    entry = REGISTRY.get("memory", cls.name)
    assert entry.describe()["extra"] == cls.declaration.extra and entry.declaration.untrainable
