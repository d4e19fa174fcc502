"""Base memory: the newest steps, and in a conversation only what it does not tell already."""

from __future__ import annotations

from typing import Any

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.toy_env import TOY


def prompts(answers: list[str], **spec: Any) -> list[str]:
    """The newest user turn of every step."""
    seen: list[str] = []

    def script(request: Request) -> str:
        seen.append(request.messages[-1].text)
        return answers[request.tag.step]

    agent = AgentSpec.from_data({"reasoning": {"name": "direct", "max_retries": 0}, "memory": "base", **spec})
    Runner(agent, ScriptedLLM(script)).run([Job(Task(TOY, 0, {"steps": len(answers)}))])
    return seen


def test_a_conversation_is_told_nothing_twice() -> None:
    shown = prompts(["WAIT()"] * 4, layout="conversation")
    assert not any("Memory:" in text for text in shown)
    assert "3. WAIT() -> " in prompts(["WAIT()"] * 4, layout="snapshot")[-1]


def test_a_failure_whose_reason_no_observation_gives_is_told() -> None:
    shown = prompts(["JUMP()", "WAIT()", "WAIT()"], layout="conversation")
    assert "1. JUMP() -> there is no action JUMP" in shown[1] and "WAIT() ->" not in shown[2]


def test_steps_that_a_conversation_has_let_go_are_told() -> None:
    # Once three steps are held the prompt starts over with the newest one, so 1, 2 and 1 again of the steps before the
    # prompts of steps 4 to 6 (counted from 1) stand in the conversation; the window is five.
    shown = prompts(["WAIT()"] * 6, layout="conversation", max_turns=3)
    told = [[n for n in range(1, 6) if f"{n}. WAIT() -> " in text] for text in shown]
    assert told == [[], [], [], [1, 2], [1, 2], [1, 2, 3, 4]]


def test_what_is_new_is_told_of_an_observation() -> None:
    """The mission, and that the agent turned, are known: the room goes to what is in view."""
    seen: list[str] = []

    def script(request: Request) -> str:
        seen.append(request.messages[-1].text)
        return "turn left"

    options = {"suite": "memory", "observation": "compact", "action_mode": "menu", "max_steps": 4}
    size = {"observation_tokens": 130}  # a scripted model counts characters
    for reasoning in ("direct", {"name": "react", **size}):
        seen.clear()
        agent = AgentSpec.from_data({"reasoning": reasoning, "memory": {"name": "base", **size}, "layout": "snapshot"})
        Runner(agent, ScriptedLLM(script)).run([Job(Task("minigrid", 0, options))])
        told = [turn for turn in seen if "Mission:" in turn][-1]
        assert told.count("Mission: go to the matching object") <= 2  # of the first step, and of this one
        assert "In view: green key 2 forward, 1 right; green ball 1 forward, 3 left" in " ".join(told.split())
        assert "turned left | Last: turned left" not in told and "before it: Last: turned left" not in told


def test_the_state_is_restored_with_what_is_told_of_it() -> None:
    from agentspec.llm.recorder import Recorder

    agent = AgentSpec.from_data({"memory": "base"}).build(Recorder(ScriptedLLM(["x"]), episode="e", seed=0))
    agent.memory._steps.append(("1. A() -> no (+1.00)", "failure"))
    blob = agent.memory.snapshot()
    agent.memory.begin_episode(Task(TOY, 0))
    agent.memory.restore(blob)
    assert list(agent.memory._steps) == [("1. A() -> no (+1.00)", "failure")] and agent.memory.snapshot() == blob
