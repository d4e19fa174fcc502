"""Generative Agent Memory: what the conversation tells is not recalled; how an episode ended is an event."""

from __future__ import annotations

import asyncio

from agentspec.context import Context
from agentspec.memory.generative import GenerativeMemory
from tests.memory.by_hand import TASK, Asked, episode, learn, recall, services, step


def talked(turns: int, *, reason_told: bool) -> tuple[GenerativeMemory, Context]:
    """Four steps in a conversation that holds the newest `turns`; the third one failed."""
    context = Context("conversation", max_turns=turns)
    memory = GenerativeMemory(services(Asked(), context=context), top=9)
    for i in range(4):
        error = "the door is shut" if i == 2 else ""
        context.prompt("", f"state {i}" + (" It says: the door is shut." if reason_told and i == 3 else ""))
        context.close(("WAIT()",))
        learn(memory, step(i, f"state {i}", f"GO({i})", error=error))
    return memory, context


def test_steps_that_the_conversation_holds_are_not_recalled() -> None:
    for turns, held in ((9, {0, 1, 2, 3}), (3, {2, 3})):  # the third turn is that of the next step
        memory, context = talked(turns, reason_told=True)
        assert context.told == len(held)
        shown = "\n".join(recall(memory, "state 1"))
        assert {i for i in range(4) if f"GO({i})" not in shown} == held
    memory, _ = talked(9, reason_told=False)  # why the third step failed is told nowhere else
    assert recall(memory, "state 1")[1:] == ["State: state 2\n3. GO(2) -> the door is shut"]
    memory.services.clock.episode, memory.services.clock.step = 1, 0
    assert len(recall(memory, "state 1")) == 5  # another episode's conversation held them


def test_how_an_episode_ended_is_an_event() -> None:
    for importance, worth in (("reward", 2.0), ("llm", 9.0)):
        script = Asked(rate='{"ratings": [3, 9]}')
        memory = GenerativeMemory(services(script), importance=importance, every=5, reflection=False)
        steps = [step(0, "a", reward=2.0, ended=True)]
        learn(memory, *steps)
        asyncio.run(memory.end_episode(episode(*steps, success=True)))
        memory.services.clock.episode, memory.services.clock.before = 1, 1
        memory.begin_episode(TASK)
        shown = recall(memory, "a")
        assert "(Episode 1, over) The episode ended after 1 steps. Return: +2.00, a success." in shown
        assert memory.stream.importance(1) == worth and script.purposes == ["rate"] * (importance == "llm")
