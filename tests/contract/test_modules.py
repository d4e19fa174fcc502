"""The contract of every registered memory, reasoning and reflection module, under each of its presets."""

from __future__ import annotations

import asyncio
import dataclasses

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import REGISTRY
from agentspec.trajectory import Trajectory
from agentspec.types import Action, ActionError, ActionSchema, AgentInput, Decision, Recall, Task
from tests.contract.harness import (
    KINDS,
    MALFORMED,
    OCCASION,
    Case,
    HashEmbedder,
    cases,
    lively,
    play,
    restless,
    start,
    steps,
)
from tests.reasoning.numbers_env import ACTIONS, NUMBERS

every_module = pytest.mark.parametrize("case", cases(), ids=str)
both_layouts = pytest.mark.parametrize("layout", ["conversation", "snapshot"])
both_modes = pytest.mark.parametrize("menu", [False, True], ids=["free", "menu"])


def test_modules_are_left_out_only_for_their_environment() -> None:
    covered = {(c.kind, c.name) for c in cases()}
    for kind in KINDS:
        for name, entry in REGISTRY.entries[kind].items():
            assert (kind, name) in covered or entry.envs


@both_modes
@both_layouts
@every_module
def test_outputs_are_typed_calls_declared_and_recorded(case: Case, layout: str, menu: bool) -> None:
    played = play(case, lively, menu=menu, layout=layout)
    calls = {c.id: c for c in played.recorder.calls}
    assert sorted(calls) == [r.id for r in played.requests]  # nothing bypasses the recorder
    for decision in played.decisions:
        assert isinstance(decision, Decision) and isinstance(decision.action, Action | ActionError)
        assert decision.valid <= isinstance(decision.action, Action)
        for call_id, index in decision.calls:
            assert calls[call_id].completions[index].credit == "executed"
    for call in calls.values():
        if call.tag.module == f"{case.kind}.{case.name}":
            assert call.tag.purpose in case.entry.purposes
    recall = asyncio.run(played.agent.memory.retrieve(played.transitions[-1].input))
    assert isinstance(recall, Recall)


@both_modes
@both_layouts
@pytest.mark.parametrize("script", [lively, restless, *MALFORMED.values()], ids=["lively", "restless", *MALFORMED])
@every_module
def test_calls_stay_within_the_declared_profile(case: Case, script, layout: str, menu: bool) -> None:
    """Also the fuzz: no answer, however malformed, raises or leaves state that cannot be saved and read again."""
    played = play(case, script, menu=menu, layout=layout)
    assert len(played.transitions) == 3
    for occasion in set(OCCASION.values()):
        fewest, most = getattr(case.profile, occasion)
        for count in played.counts.get(occasion, []):
            assert fewest <= count <= most, f"{case}: {count} calls per {occasion}, declared {fewest} to {most}"
    module = played.module(case)
    blob = module.snapshot()
    module.restore(blob)
    assert module.snapshot() == blob


@both_modes
@both_layouts
@every_module
def test_a_restored_snapshot_is_the_state_it_was_taken_of(case: Case, layout: str, menu: bool) -> None:
    played = start(case, lively, layout=layout)
    episode = steps(played, Task(NUMBERS, 0, {"menu": menu, "steps": 5, "target": 1000}))
    for _ in range(2):
        next(episode)
    module = played.module(case)
    blob, before = module.snapshot(), _remembered(played, case)
    next(episode)
    module.restore(blob)
    assert module.snapshot() == blob and _remembered(played, case) == before
    # Into another instance too; its episode goes on.
    other = start(case, lively, layout=layout)
    episode = steps(other, Task(NUMBERS, 0, {"menu": menu, "steps": 5, "target": 1000}))
    next(episode)
    other.module(case).restore(blob)
    assert other.module(case).snapshot() == blob
    next(episode)


def _remembered(played, case: Case) -> Recall:
    """What the module contributes to a prompt."""
    seen = played.transitions[1].input
    if case.kind == "memory":
        return asyncio.run(played.module(case).retrieve(seen))
    return asyncio.run(played.module(case).lessons(seen)) if case.kind == "reflection" else Recall()


def _run(case: Case, script, tasks: list[Task], layout: str, **more) -> list[Trajectory]:
    runner = Runner(case.spec(layout, **more), ScriptedLLM(script), embedder=HashEmbedder())
    return runner.run([Job(t) for t in tasks])


def _timeless(trajectory: Trajectory) -> str:
    calls = tuple(dataclasses.replace(c, latency_s=0.0) for c in trajectory.calls)
    metrics = {k: v for k, v in trajectory.metrics.items() if k != "thinking_s"}
    return dataclasses.replace(trajectory, calls=calls, metrics=metrics).to_json()


@both_modes
@both_layouts
@every_module
def test_the_same_seed_gives_the_same_transcript(case: Case, layout: str, menu: bool) -> None:
    tasks = [Task(NUMBERS, seed, {"menu": menu, "steps": 2, "target": 1000}) for seed in (0, 1)]
    together = _run(case, lively, tasks, layout)
    apart = [t for task in reversed(tasks) for t in _run(case, lively, [task], layout)][::-1]
    assert [_timeless(t) for t in together] == [_timeless(t) for t in apart]
    assert [Trajectory.from_json(t.to_json()).calls for t in together] == [t.calls for t in together]


@pytest.mark.parametrize("budget", [0, 1, 2, 4, 9])
@both_modes
@every_module
def test_an_exhausted_budget_is_flagged_and_ends_in_order(case: Case, menu: bool, budget: int) -> None:
    task = Task(NUMBERS, 0, {"menu": menu, "steps": 3, "target": 1000})
    (trajectory,) = _run(case, restless, [task], "conversation", budget={"calls": budget})
    assert trajectory.status == "completed" and trajectory.metrics["llm_calls"] <= budget
    (free,) = _run(case, restless, [task], "conversation")
    if len(free.calls) > budget and len(trajectory.transitions) == 3:
        # Fewer calls than it wanted: some decision says so, or what was left out was no decision.
        flagged = [t for t in trajectory.transitions if t.decision.trace.get("exhausted")]
        decided = [c for c in free.calls if c.tag.module.split(".")[0] == "reasoning" or c.tag.purpose == "refine"]
        assert flagged or len(decided) <= budget


@both_layouts
@every_module
def test_nothing_to_go_by_is_no_reason_to_fail(case: Case, layout: str) -> None:
    played = start(case, MALFORMED["empty"], layout=layout)
    task = Task(NUMBERS, 0)
    from agentspec.episode import make_env
    from agentspec.simulator import simulator_of
    from tests.contract.harness import Inline

    env = make_env(task)
    env.reset(seed=0)
    agent = played.agent
    agent.attach_simulator(simulator_of(env, Inline(), task, agent.perception))
    agent.begin_episode(task)
    nothing = AgentInput("", "", ActionSchema(ACTIONS))
    assert isinstance(asyncio.run(agent.memory.retrieve(nothing)), Recall)
    assert isinstance(asyncio.run(agent.reflection.lessons(nothing)), Recall)
    decision = asyncio.run(agent.reasoning.decide(nothing, Recall()))
    assert isinstance(asyncio.run(agent.reflection.revise(nothing, Recall(), decision)), Decision)
    asyncio.run(agent.end_episode(Trajectory(task, {})))


def test_needs_and_waivers_name_what_exists() -> None:
    from agentspec.spec import ModuleSpec

    known = {"token_ids", "logprobs", "choices", "score", "n", "snapshots"}
    for case in cases():
        assert set(case.entry.needs) <= known
        for need, (parameter, value) in case.entry.waived.items():
            assert need in case.entry.needs
            module = ModuleSpec.parse(case.kind, {"name": case.name, parameter: value})
            assert need not in case.entry.needs_with(module.params)
