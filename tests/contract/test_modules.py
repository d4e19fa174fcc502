"""The contract of every registered memory, reasoning and reflection module, under each of its presets."""

from __future__ import annotations

import asyncio
import dataclasses
import json

import pytest

from agentspec.embedding import HashEmbedder
from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import REGISTRY
from agentspec.trajectory import Trajectory
from agentspec.types import Action, ActionError, ActionSchema, AgentInput, Decision, Recall, RecallItem, Task
from tests.contract.harness import (
    KINDS,
    LENGTH,
    MALFORMED,
    OCCASION,
    SCRIPTS,
    Case,
    Played,
    affordable,
    begin,
    cases,
    example,
    lively,
    play,
    restless,
    scripts,
    start,
    steps,
)
from tests.reasoning.numbers_env import ACTIONS, NUMBERS

every_module = pytest.mark.parametrize("case", cases(), ids=str)
both_layouts = pytest.mark.parametrize("layout", ["conversation", "snapshot"])
both_modes = pytest.mark.parametrize("menu", [False, True], ids=["free", "menu"])


def test_modules_are_left_out_only_for_their_environment_or_library() -> None:
    covered = {(c.kind, c.name) for c in cases()}
    for kind in KINDS:
        for name, entry in REGISTRY.all(kind).items():
            assert (kind, name) in covered or entry.scripted or entry.declaration.extra


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
@pytest.mark.parametrize("model", SCRIPTS)
@every_module
def test_calls_stay_within_the_declared_profile(case: Case, model: str, layout: str, menu: bool) -> None:
    """Also the fuzz: no answer, however malformed, raises or leaves state that cannot be saved and read again."""
    long = case.kind != "reasoning" or (case.affordable and layout == "conversation")
    length = LENGTH if long else 3
    played = play(case, scripts(case)[model], menu=menu, layout=layout, length=length)
    assert len(played.transitions) == length
    for occasion in set(OCCASION.values()):
        fewest, most = getattr(case.profile, occasion)
        for count in played.counts.get(occasion, []):
            assert fewest <= count <= most, f"{case}: {count} calls per {occasion}, declared {fewest} to {most}"
    module = played.module(case)
    blob = module.snapshot()
    module.restore(blob)
    assert module.snapshot() == blob


@pytest.mark.parametrize("name", sorted({c.name for c in cases(("memory",)) if c.entry.purposes}))
def test_every_purpose_of_a_memory_fires_within_a_dozen_steps(name: str) -> None:
    """In two episodes of a run; and what is declared as well-formed is read as such."""
    fired: set[str] = set()
    mine = [c for c in affordable(("memory",)) if c.name == name]
    for case in mine:
        first = play(case, example(case), length=LENGTH)
        second = play(case, example(case), length=LENGTH, carried=first.agent.carry())
        for played in (first, second):
            fired |= {c.tag.purpose for c in played.recorder.calls if c.tag.module == case.path}
            problems = {problem: n for (module, problem), n in played.recorder.problems.items() if module == case.path}
            assert not problems, f"{case} cannot use the examples that it declares: {problems}"
    assert fired == set(mine[0].entry.purposes), "declare `small` parameters under which it does all it does"


@pytest.mark.parametrize("at", [2, 7, 11])
@both_modes
@both_layouts
@pytest.mark.parametrize("case", affordable(), ids=str)
def test_a_restored_snapshot_is_the_state_it_was_taken_of(case: Case, layout: str, menu: bool, at: int) -> None:
    task = Task(NUMBERS, 0, {"menu": menu, "steps": LENGTH, "target": 1000})
    played = start(case, example(case), layout=layout)
    episode = steps(played, task)
    for _ in range(at):
        next(episode)
    module = played.module(case)
    seen = played.transitions[1].input
    blob, before, spoken = module.snapshot(), _remembered(played, case, seen), played.agent.context.snapshot()
    next(episode)
    module.restore(blob)
    played.agent.context.restore(spoken)  # what it tells, a memory may leave out
    played.agent.clock.step = at
    assert module.snapshot() == blob and _remembered(played, case, seen) == before
    # Into a fresh instance too; its episode goes on.
    other = start(case, example(case), layout=layout)
    begin(other, task)
    other.agent.clock.step = at
    other.agent.context.restore(spoken)
    other.module(case).restore(blob)
    assert other.module(case).snapshot() == blob and _remembered(other, case, seen) == before
    other = start(case, example(case), layout=layout)
    episode = steps(other, task)
    next(episode)
    other.module(case).restore(blob)
    assert other.module(case).snapshot() == blob
    next(episode)


def _remembered(played: Played, case: Case, seen: AgentInput) -> Recall:
    """What the module contributes to a prompt."""
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
@pytest.mark.parametrize("case", affordable(("memory", "reflection")), ids=str)
def test_forks_of_a_run_never_leak(case: Case, layout: str) -> None:
    """Episodes that start from the same state and play side by side are each as they would be alone."""
    first, *tasks = [Task(NUMBERS, seed, {"menu": False, "steps": LENGTH, "target": 1000}) for seed in (0, 0, 1, 2)]
    runner = Runner(case.spec(layout, scope="run"), ScriptedLLM(example(case)), embedder=HashEmbedder())
    state = runner.run([Job(first)])[0].memory_state
    assert state is not None
    jobs = [Job(task, i, memory_state=state) for i, task in enumerate(tasks)]
    together = runner.run(jobs)
    alone = [runner.run([job])[0] for job in reversed(jobs)][::-1]
    assert [_timeless(t) for t in together] == [_timeless(t) for t in alone]
    assert [t.memory_state for t in together] == [t.memory_state for t in alone]
    # And the run goes on: time and ids do not begin anew.
    assert json.loads(together[0].memory_state or b"")["time"]["episode"] == 2


@both_layouts
@every_module
def test_nothing_to_go_by_is_no_reason_to_fail(case: Case, layout: str) -> None:
    played = start(case, MALFORMED["empty"], layout=layout)
    task = Task(NUMBERS, 0)
    agent = played.agent
    begin(played, task)
    nothing = AgentInput("", "", ActionSchema(ACTIONS))
    assert isinstance(asyncio.run(agent.memory.retrieve(nothing)), Recall)
    assert isinstance(asyncio.run(agent.reflection.lessons(nothing)), Recall)
    decision = asyncio.run(agent.reasoning.decide(nothing, Recall()))
    assert isinstance(asyncio.run(agent.reflection.revise(nothing, Recall(), decision)), Decision)
    asyncio.run(agent.end_episode(Trajectory(task, {})))


def test_needs_and_waivers_name_what_exists() -> None:
    from agentspec.spec import ModuleSpec

    known = {"token_ids", "logprobs", "choices", "score", "n", "snapshots", "embedder"}
    for case in cases():
        assert set(case.entry.needs) <= known
        for need, (parameter, value) in case.entry.waived.items():
            assert need in case.entry.needs
            module = ModuleSpec.parse(case.kind, {"name": case.name, parameter: value})
            assert need not in case.entry.needs_with(module.params)
        ModuleSpec.parse(case.kind, {"name": case.name, **case.params})


class Marked:
    """A memory that recalls one thing, always."""

    def __init__(self, inner: object) -> None:
        self.inner = inner

    def __getattr__(self, name: str) -> object:
        return getattr(self.inner, name)

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        return Recall((RecallItem("REMEMBER-7"),))


@both_modes
@both_layouts
@pytest.mark.parametrize("case", affordable(("reasoning", "reflection")), ids=str)
def test_every_prompt_of_a_step_shows_what_memory_recalled_once(case: Case, layout: str, menu: bool) -> None:
    played = start(case, lively, layout=layout)
    played.agent.memory = Marked(played.agent.memory)  # type: ignore[assignment]
    for _ in steps(played, Task(NUMBERS, 0, {"menu": menu, "steps": 3, "target": 1000})):
        pass
    for request in played.requests:
        if request.tag.path.startswith("reasoning.") or request.tag.purpose in ("feedback", "refine"):
            text = "".join(m.text for m in request.messages)
            assert text.count("REMEMBER-7") == 1, request.tag.path
