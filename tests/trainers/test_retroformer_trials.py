"""The lesson at the start of the next trial: the same lesson, in the episode that pays it."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.base import ContextOverflowError
from agentspec.llm.scripted import ScriptedLLM
from agentspec.reflection.retroformer import PATH, Retroformer
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.reasoning.numbers_env import NUMBERS
from tests.reflection.test_reflexion import INPUT, learner, module, run, shown, trial

TASK = Task(NUMBERS, 0)


def chain(when: str, script=learner, trials: int = 2, **more) -> list[Trajectory]:
    reflection = {"name": "retroformer", "when": when, "temperature": 0.5}
    spec = AgentSpec.from_data({"reasoning": "direct", "reflection": reflection, "scope": "run", **more})
    runner, played, state = Runner(spec, ScriptedLLM(script)), [], None
    for i in range(trials):
        played += runner.run([Job(TASK, run_seed=i, memory_state=state)])
        state = played[-1].memory_state
    return played


def lessons(trajectory: Trajectory) -> list:
    return [c for c in trajectory.calls if c.tag.path == PATH]


def test_the_same_lesson_one_episode_later() -> None:
    at_end, at_start = chain("end"), chain("start")
    (lesson,), (later,) = lessons(at_end[0]), lessons(at_start[1])
    assert not lessons(at_end[1]) and not lessons(at_start[0])
    assert later.prompt_ids == lesson.prompt_ids and later.text == lesson.text
    assert [t.action_text for t in at_start[1].transitions] == [t.action_text for t in at_end[1].transitions]
    assert at_start[1].metrics["success"] and at_start[0].metrics["reflection/due"]
    for played, call in ((at_end, lesson), (at_start, later)):
        assert call.completions[0].credit == "executed" and call.sampling.temperature == 0.5
        assert played[1].metrics["reflection/reward"] == 1.0  # the puzzle pays 1 when it is solved
        paid = played[1].metrics["reflection/episode"], played[1].metrics["reflection/call"]
        assert paid == (f"{call.tag.episode}", call.id)


def test_lessons_drawn_from_one_memory_are_paid_each_by_its_own_trial() -> None:
    spec = AgentSpec.from_data(chain("start", trials=1)[0].spec)
    state = chain("start", trials=1)[0].memory_state

    def script(request):
        # The second rollout's reflector has nothing to say.
        silent = request.tag.purpose == "reflect" and request.tag.episode.split("-")[1] == "1"
        return "" if silent else learner(request)

    llm = ScriptedLLM(script)
    both = Runner(spec, llm).run([Job(TASK, i, memory_state=state) for i in range(2)])
    assert [t.metrics["reflection/reward"] for t in both] == [1.0, 0.0]
    assert len({lessons(t)[0].prompt_ids for t in both}) == 1  # about one and the same failed trial
    # An empty answer is a choice as well, and it is paid; but it is no lesson.
    assert lessons(both[1])[0].completions[0].credit == "executed"
    prompts = [llm.tokenizer.decode(t.calls[1].prompt_ids) for t in both]
    assert ["Lessons from" in p for p in prompts] == [True, False]


def test_a_lesson_that_is_due_survives_a_snapshot() -> None:
    retro, recorder = module(["lesson"], Retroformer, threshold=5.0, when="start")
    run(retro, trial(1.0))
    assert recorder.calls == [] and retro.metrics() == {"due": True}
    other, others = module(["lesson"], Retroformer, threshold=5.0, when="start")
    other.restore(retro.snapshot())
    assert other.snapshot() == retro.snapshot()
    assert shown(other, TASK) == shown(retro, TASK) and "Trial 0: lesson" in shown(other, TASK)[0]
    assert others.calls[0].prompt_ids == recorder.calls[0].prompt_ids and len(others.calls) == 1
    run(other, trial(4.0))
    assert other.metrics()["reward"] == 3.0 and other.metrics()["episode"] == "e"


def test_a_lesson_is_written_for_its_own_task_only() -> None:
    retro, recorder = module(["lesson"], Retroformer, threshold=5.0, when="start")
    run(retro, trial(1.0))
    assert shown(retro, replace(TASK, seed=1)) == [] and recorder.calls == []
    run(retro, trial(9.0, task=replace(TASK, seed=2)))
    assert retro.metrics() == {}  # good enough: nothing is due
    assert len(shown(retro, TASK)) == 1 and len(recorder.calls) == 1
    shown(retro, TASK)
    assert len(recorder.calls) == 1  # once


def test_a_trial_without_room_for_a_lesson_is_played_without_one() -> None:
    retro, _ = module(["lesson"], Retroformer, threshold=5.0, when="start")
    run(retro, trial(1.0))

    async def full(*_, **__):
        raise ContextOverflowError("too long")

    retro.services.llm.recorder.llm.generate = full
    retro.begin_episode(TASK)
    assert asyncio.run(retro.lessons(INPUT)).items == ()
    run(retro, trial(2.0))
    assert "reward" not in retro.metrics()


def test_an_unknown_time_is_refused() -> None:
    with pytest.raises(SpecError, match="when must be one of end, start; got 'later'"):
        module(["lesson"], Retroformer, when="later")
