"""A memory that was restored goes on as the one it was saved from: it recalls, asks and keeps the same."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import Any

import pytest

from agentspec.llm.base import Request
from agentspec.types import Recall, Task, Transition
from tests.contract.harness import LENGTH, Case, Played, affordable, begin, constant, example, play, start, steps
from tests.reasoning.numbers_env import NUMBERS

ACTIONS = ("ADD()", "NONE()", "SUB()")
MORE = 3
"""Steps after the restoration."""

GARBAGE = constant('```json\n{"facts": [1, {"text": null}], "operations": "none", "op": 7\n```\nI cannot do that.')
TASK = Task(NUMBERS, 1, {"menu": False, "steps": LENGTH, "target": 1000})


class Copy:
    """An agent whose episode can be taken up by another one, step by step."""

    def __init__(self, case: Case, script: Any, layout: str, carried: bytes) -> None:
        self.played: Played = start(case, script, layout=layout)
        self.played.agent.resume(carried)
        self.env, self.observation, self.info = begin(self.played, TASK)
        self.actions: list[str] = []

    def act(self, action: str) -> tuple[float, bool, bool]:
        """Do it in the environment."""
        self.actions.append(action)
        self.observation, reward, terminated, truncated, self.info = self.env.step(action)
        return reward, terminated, truncated

    def go_on(self) -> tuple[Recall, bytes]:
        """One step of the agent: what it recalled, and the state of its memory after it."""
        agent, recalls = self.played.agent, list[Recall]()
        remember = agent.memory.retrieve

        async def kept(*args: Any) -> Recall:
            recalls.append(await remember(*args))
            return recalls[-1]

        agent.memory.retrieve = kept  # type: ignore[method-assign]
        seen, decision = asyncio.run(agent.decide(TASK, self.observation, self.info))
        agent.memory.retrieve = remember  # type: ignore[method-assign]
        number, text = len(self.actions), decision.action.text
        reward, *ended = self.act(text)
        report = {name: self.info[name] for name in ("error", "message", "invalid")}
        step = Transition(number, seen, decision, text, reward, self.observation["text"], *ended, report)
        asyncio.run(agent.learn(step))
        return recalls[0], agent.memory.snapshot()

    def take_up(self, other: Copy) -> None:
        """Conversation, time, ids and memory of another one."""
        for action in other.actions:
            self.act(action)
        ours, theirs = self.played.agent, other.played.agent
        clock = theirs.clock
        ours.clock.resume({"episode": clock.episode, "before": clock.before, "ids": clock._ids})
        ours.clock.step = clock.step
        ours.context.restore(theirs.context.snapshot())
        ours.memory.restore(theirs.memory.snapshot())


@pytest.mark.parametrize("at", [3, 8])
@pytest.mark.parametrize("model", ["example", "garbage"])
@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("case", affordable(("memory",)), ids=str)
def test_a_restored_memory_goes_on_as_it_would_have(case: Case, layout: str, model: str, at: int) -> None:
    """In the second episode of a run, at a step between two writes: everything that is open then is in the snapshot."""
    answer = example(case) if model == "example" else GARBAGE

    def script(request: Request) -> Any:
        """Of the actor the same actions, whatever calls the memory has made."""
        return ACTIONS[request.tag.step % 3] if request.tag.module.startswith("reasoning.") else answer(request)

    first = start(case, script, layout=layout)
    for _ in steps(first, dataclasses.replace(TASK, seed=0)):
        pass
    carried = first.agent.carry()
    one = Copy(case, script, layout, carried)
    for _ in range(at):
        one.go_on()
    other = Copy(case, script, layout, carried)
    other.take_up(one)
    assert other.played.agent.memory.snapshot() == one.played.agent.memory.snapshot()
    for _ in range(MORE):
        assert other.go_on() == one.go_on()


OF_THE_PRESENT = (
    "buffer_of_thought/distil",
    "chatdb/query",
    "chatdb/fill",
    "dynamic_cheatsheet/synthesise",
    "gmemory/relevance",
    "mirix/topic",
)
"""Purposes that are about the task that begins."""


@pytest.mark.parametrize("length", [LENGTH - 1, LENGTH])
@pytest.mark.parametrize("case", affordable(("memory",)), ids=str)
def test_what_an_earlier_episode_left_is_told_under_the_task_it_had(case: Case, length: int) -> None:
    """The next episode of a run may have another task (in ALFRED every one has)."""
    other = "Put a clean mug on the desk."
    first = play(case, example(case), length=length)
    second = start(case, example(case))
    second.agent.resume(first.agent.carry())
    _, observation, info = begin(second, TASK)
    seen = second.agent.perception.perceive(TASK, observation, {**info, "instruction": other})
    asyncio.run(second.agent.memory.retrieve(seen))
    for request in second.requests:
        if request.tag.path.removeprefix("memory.") not in OF_THE_PRESENT:
            assert other not in "".join(m.text for m in request.messages), request.tag.path
