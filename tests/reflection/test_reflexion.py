"""Reflexion: no call after success, the last three lessons in order, kept by task; the second trial solves."""

from __future__ import annotations

import asyncio
import random
import re

import pytest

from agentspec.context import Context
from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.recorder import ModuleLLM, Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.protocols import Services, StepClock
from agentspec.reflection.reflexion import Reflexion
from agentspec.reflection.trials import failed, key_of
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Action, ActionSchema, AgentInput, Decision, Task, Transition
from tests.reasoning.numbers_env import ACTIONS, NUMBERS
from tests.reasoning.player import greedy_player, last, named, operations, play, purposes, seen, solve, solved

SPEC = {"reasoning": "direct", "reflection": "reflexion", "scope": "run"}


def learner(request: Request) -> str:
    """Acts greedily unless a lesson says what to do at this number; hindsight finds the lesson."""
    if request.tag.purpose == "reflect":
        number, target, left = seen(last(request))
        lesson = []
        for name in solve(number, target, left) or []:
            lesson.append(f"at {number} play {name}()")
            number = {"ADD": number + 3, "DOUBLE": 2 * number, "SUB": number - 1}[name]
        return "; ".join(lesson)
    text = "\n".join(m.text for m in request.messages if m.role == "user")
    number, _, _ = seen(text)
    told = re.findall(rf"at {number} play (\w+\(\))", text)
    return named(operations(told[-1])[0], request) if told else greedy_player(request)


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("menu", [False, True])
@pytest.mark.parametrize("method", ["reflexion", "retroformer"])
def test_the_second_trial_solves_what_the_first_does_not(method: str, menu: bool, layout: str) -> None:
    spec = {**SPEC, "reflection": method, "layout": layout}
    first, requests = play(learner, spec, menu=menu)
    assert not solved(first) and purposes(requests)[-1] == "reflect"
    second, requests = play(learner, spec, menu=menu, jobs=2)
    assert solved(second)
    assert purposes(requests).count("reflect") == 1  # none after the success


@pytest.mark.parametrize("method", ["reflexion", "retroformer"])
def test_lessons_that_nobody_would_read_are_refused(method: str) -> None:
    with pytest.raises(SpecError, match="set `scope: run`"):
        AgentSpec.from_data({**SPEC, "reflection": method, "scope": "episode"})


INPUT = AgentInput("Earn.", "It begins.", ActionSchema(ACTIONS))


def trial(*rewards: float, task: Task | None = None, actions: tuple[str, ...] = (), **metrics) -> Trajectory:
    steps = tuple(
        Transition(i, INPUT, Decision(Action("ADD", text="ADD()")), actions[i] if actions else f"ADD({i})", r, "next")
        for i, r in enumerate(rewards)
    )
    return Trajectory(task or Task(NUMBERS, 0), {}, transitions=steps, metrics=metrics)


def module(answers, cls=Reflexion, **params):
    recorder = Recorder(ScriptedLLM(answers), episode="e", seed=0)
    services = Services(ModuleLLM(recorder, f"reflection.{cls.name}"), Context(), StepClock(), random.Random(0))
    return cls(services, **params), recorder


def run(reflexion, *trajectories: Trajectory) -> None:
    for t in trajectories:
        reflexion.begin_episode(t.task)
        asyncio.run(reflexion.end_episode(t))


def shown(reflexion, task: Task) -> list[str]:
    reflexion.begin_episode(task)
    return [item.text for item in asyncio.run(reflexion.lessons(INPUT)).items]


def test_only_the_last_lessons_are_shown_in_order() -> None:
    reflexion, _ = module([f"lesson {i}" for i in range(5)])
    run(reflexion, *(trial(0.0) for _ in range(5)))
    task = Task(NUMBERS, 0)
    # Nothing is ever earned, so no trial beats the best one (0): each has a lesson, three are shown.
    assert len(shown(reflexion, task)) == 3
    reflexion, _ = module([f"lesson {i}" for i in range(5)], threshold=1.0)
    run(reflexion, *(trial(0.0) for _ in range(5)))
    lines = shown(reflexion, task)
    assert [line.split("\n")[-1] for line in lines] == [f"Trial {i}: lesson {i}" for i in (2, 3, 4)]
    recall = asyncio.run(reflexion.lessons(INPUT))
    assert Context().recalled(recall).startswith("Lessons from earlier trials")


def test_lessons_are_kept_by_task_or_by_family() -> None:
    mine, other = Task(NUMBERS, 0), Task(NUMBERS, 1)
    reflexion, _ = module(["lesson"])
    run(reflexion, trial(0.0, task=mine))
    assert shown(reflexion, mine) and not shown(reflexion, other)
    family, _ = module(["lesson"], key="family")
    run(family, trial(0.0, task=mine))
    assert shown(family, other) and not shown(family, Task(NUMBERS, 0, {"steps": 9}))
    assert key_of(mine, "family") == key_of(other, "family") != key_of(mine, "task")


def test_the_reflector_reads_trial_return_and_lessons() -> None:
    reflexion, recorder = module(["first lesson", "second lesson"], threshold=5.0)
    run(reflexion, trial(1.5), trial(0.0, 2.0))
    prompt = recorder.llm.tokenizer.decode(recorder.calls[1].prompt_ids)
    for text in ("first lesson", "It begins.", "1. ADD(0)", "2. ADD(1)", "return was 2", "best so far 1.5", "trial 1"):
        assert text in prompt


@pytest.mark.parametrize(
    ("rewards", "best", "threshold", "metrics", "fails"),
    [
        ((1.0,), None, None, {}, True),  # a first dollar is no success of a graded task
        ((0.0,), None, None, {}, True),
        ((1.0,), 2.0, None, {}, True),  # below the best so far
        ((2.0,), 2.0, None, {}, True),  # no better than the best so far
        ((2.5,), 2.0, None, {}, False),
        ((3.0,), None, 3.0, {}, False),
        ((2.0,), 1.0, 3.0, {}, True),  # below the threshold
        ((4.0,), 9.0, 3.0, {}, False),
        ((9.0,), None, None, {"success": False}, True),  # the environment knows best
        ((0.0,), 1.0, 3.0, {"success": True}, False),
    ],
)
def test_what_counts_as_failure(rewards, best, threshold, metrics, fails) -> None:
    assert failed(trial(*rewards, **metrics), best, threshold) is fails


def test_the_same_action_over_and_over_is_a_failure() -> None:
    looping = trial(0.0, 0.0, 0.0, 5.0, actions=("A()", "A()", "A()", "B()"))
    assert failed(looping, None, 1.0, max_repeats=3) and not failed(looping, None, 1.0, max_repeats=4)


def test_an_empty_lesson_and_an_empty_trial_change_nothing() -> None:
    reflexion, recorder = module([" \n"])
    run(reflexion, trial(0.0), trial())
    assert len(recorder.calls) == 1 and shown(reflexion, Task(NUMBERS, 0)) == []


def test_state_survives_a_snapshot() -> None:
    reflexion, _ = module(["a", "b"], threshold=1.0)
    run(reflexion, trial(0.0))
    blob, before = reflexion.snapshot(), shown(reflexion, Task(NUMBERS, 0))
    run(reflexion, trial(0.5))
    assert reflexion.snapshot() != blob
    reflexion.restore(blob)
    assert reflexion.snapshot() == blob and shown(reflexion, Task(NUMBERS, 0)) == before


def test_the_trials_of_a_run_travel_with_the_memory_state() -> None:
    spec = AgentSpec.from_data(SPEC)
    (trajectory,) = Runner(spec, ScriptedLLM(learner)).run([Job(Task(NUMBERS, 0))])
    assert trajectory.memory_state is not None and trajectory.memory_state != b""
