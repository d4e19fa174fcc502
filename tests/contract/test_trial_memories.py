"""Memories from outside, through the contract and through three chained episodes inside other scaffolds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.contract.harness import LENGTH, OCCASION, SCRIPTS, Case, example, play, scripts, variants
from tests.fixtures import trial_memories
from tests.reasoning.numbers_env import NUMBERS

NAMES = ("blocks", "cheat_sheet", "insights", "ranked", "table")


@pytest.fixture(autouse=True, scope="module")
def registered() -> Iterator[None]:
    assert sorted(REGISTRY.add_module(trial_memories)) == sorted(NAMES)
    yield
    for name in NAMES:
        REGISTRY.unregister("memory", name)


def small(name: str) -> Case:
    return variants("memory", name, REGISTRY.get("memory", name))[-1]


@pytest.mark.parametrize("model", SCRIPTS)
@pytest.mark.parametrize("name", NAMES)
def test_the_contract_holds_for_them_too(name: str, model: str) -> None:
    case = small(name)
    for layout in ("conversation", "snapshot"):
        played = play(case, scripts(case)[model], layout=layout, length=LENGTH)
        assert len(played.transitions) == LENGTH
        for occasion in set(OCCASION.values()):
            fewest, most = getattr(case.profile, occasion)
            assert all(fewest <= n <= most for n in played.counts.get(occasion, []))
        module = played.module(case)
        blob = module.snapshot()
        module.restore(blob)
        assert module.snapshot() == blob
        own = [c for c in played.recorder.calls if c.tag.module == case.path]
        if model == "example" and layout == "conversation":
            assert {c.tag.purpose for c in own} == set(case.entry.purposes) and not played.recorder.problems
        if model == "wrongly-typed" and len(own) > 2:  # of seven turns of wrong answers
            assert played.recorder.problems  # counted, and nothing raised


SCAFFOLDS = ("direct", "react", "mad")


def chain(spec: AgentSpec, case: Case, chains: list[int]) -> list[list[Trajectory]]:
    """For each chain three episodes, one after the other, memory carried on; all chains side by side."""
    runner = Runner(spec, ScriptedLLM(example(case)))
    states: list[bytes | None] = [None] * len(chains)
    played: list[list[Trajectory]] = [[] for _ in chains]
    for number in range(3):
        task = {"menu": False, "steps": 6, "target": 1000}
        jobs = [
            Job(Task(NUMBERS, 10 * c + number, task), rollout=c, memory_state=state)
            for c, state in zip(chains, states, strict=True)
        ]
        for i, trajectory in enumerate(runner.run(jobs)):
            assert trajectory.status == "completed", trajectory.error
            states[i] = trajectory.memory_state
            played[i].append(trajectory)
    return played


def timeless(trajectory: Trajectory) -> tuple[str, bytes | None]:
    calls = tuple(replace(c, latency_s=0.0) for c in trajectory.calls)
    metrics = {k: v for k, v in trajectory.metrics.items() if k != "thinking_s"}
    return replace(trajectory, calls=calls, metrics=metrics).to_json(), trajectory.memory_state


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("reasoning", SCAFFOLDS)
@pytest.mark.parametrize("name", NAMES)
def test_three_chained_episodes_are_alike_alone_and_side_by_side(name: str, reasoning: str, layout: str) -> None:
    case = small(name)
    memory = {"name": name, **case.params}
    method = {"name": "mad", "preset": "rl"} if reasoning == "mad" else reasoning
    data = {"reasoning": method, "memory": memory, "layout": layout, "scope": "run", "embedder": "hash"}
    spec = AgentSpec.from_data(data)
    together = chain(spec, case, [0, 1, 2])
    alone = [chain(spec, case, [c])[0] for c in (2, 0)]
    assert [timeless(t) for t in together[2]] == [timeless(t) for t in alone[0]]
    assert [timeless(t) for t in together[0]] == [timeless(t) for t in alone[1]]
    # What was learnt in an episode is shown in the next one's first prompt.
    first = together[0][2].calls
    shown = bytes(i for c in first if c.tag.step == 0 for i in c.prompt_ids if i < 256).decode()
    assert "Memory:\n" in shown
    # The prompts of one conversation hold a recalled text once, in the newest turn.
    acts = [c for c in together[0][2].calls if c.tag.module.startswith("reasoning.")]
    assert max(bytes(i for i in c.prompt_ids if i < 256).count(b"Memory:\n") for c in acts) == 1


def test_ids_and_time_go_on_from_episode_to_episode() -> None:
    case = small("ranked")
    spec = AgentSpec.from_data({"memory": "ranked", "scope": "run", "embedder": "hash"})
    played = chain(spec, case, [0])[0]
    from agentspec.agent import Agent
    from agentspec.llm.recorder import Recorder

    agent: Agent = spec.build(Recorder(ScriptedLLM(["x"]), episode="e", seed=0))
    agent.resume(played[-1].memory_state or b"")
    entries = agent.memory.entries  # type: ignore[attr-defined]
    # Three episodes of six steps: 18 entries, none with the id of another, the last one born at step 18.
    assert [e.id for e in entries] == list(range(18)) and [e.born for e in entries] == list(range(1, 19))


def test_evicted_turns_leave_their_summary_and_shorten_the_prompt() -> None:
    last = {}
    for pressure in (400, 1_000_000):
        spec = AgentSpec.from_data({"memory": {"name": "blocks", "pressure": pressure, "keep": 1}})
        task = Task(NUMBERS, 0, {"steps": LENGTH, "target": 1000})
        (trajectory,) = Runner(spec, ScriptedLLM(example(small("blocks")))).run([Job(task)])
        acts = [c for c in trajectory.calls if c.tag.purpose == "act" and c.tag.step == LENGTH - 1]
        last[pressure] = bytes(i for i in acts[0].prompt_ids if i < 256)
    assert b"The number grew." in last[400] and b"The number grew." not in last[1_000_000]
    # One step of twelve is held, not eleven.
    assert last[400].count(b"The number is") == 2 and last[1_000_000].count(b"The number is") == LENGTH
