"""A plan that an answer carries beside its action is shown again where nothing else shows it."""

from __future__ import annotations

from typing import Any

import pytest

from agentspec.context import Context
from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.shapes import plan_of
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory, replay
from agentspec.types import Task

FIRST = '{"action": "VIEW_BAG()", "plan": "Accept 3,\\nthen \\"ride\\"."}'
PLAN = 'Your last plan: Accept 3, then "ride".'
TASK = Task("deliverybench", 0, {"size": "tiny"})


def play(answers: list[str], **spec: Any) -> tuple[Trajectory, list[Request]]:
    requests: list[Request] = []

    def script(request: Request) -> str:
        requests.append(request)
        return answers[request.tag.step]

    agent = AgentSpec.from_data({"reasoning": "direct", **spec})
    (trajectory,) = Runner(agent, ScriptedLLM(script), max_steps=len(answers)).run([Job(TASK)])
    assert not trajectory.error, trajectory.error
    return trajectory, requests


@pytest.mark.parametrize("reasoning", ["direct", "react", "cot", "plan_and_solve"])
def test_the_last_plan_stands_in_the_next_prompts(reasoning: str) -> None:
    later = '```json\n{"action": "WAIT(2)", "future_plan": ["rest", "go on"]}\n```'
    trajectory, requests = play([FIRST, "WAIT(1)", later, "WAIT(1)"], reasoning=reasoning, layout="snapshot")
    turns = [r.messages[-1].text for r in requests]
    assert "plan:" not in turns[0] and PLAN in turns[1] and PLAN in turns[2]
    assert "Your last plan: rest; go on\n" in turns[3] and PLAN not in turns[3]
    # It is no part of what is done, of the observation, or of its replay; the record keeps it.
    assert [t.action_text for t in trajectory.transitions] == ["VIEW_BAG()", "WAIT(1)", "WAIT(2)", "WAIT(1)"]
    assert trajectory.transitions[0].decision.trace["plan"] == 'Accept 3, then "ride".'
    assert not any("plan:" in t.input.text for t in trajectory.transitions)
    from agentspec.episode import make_env

    assert replay(trajectory, make_env) == []


def test_a_conversation_that_holds_the_plan_does_not_show_it_again() -> None:
    _, requests = play([FIRST, "WAIT(1)", "WAIT(1)", "WAIT(1)"], layout="conversation")
    assert not any("Your last plan" in m.text for r in requests for m in r.messages)
    # A chain that is not carried on takes its plan along; and so does a conversation that starts over.
    _, requests = play([FIRST, "WAIT(1)", "WAIT(1)"], layout="conversation", reasoning="cot")
    assert [sum(PLAN in m.text for m in r.messages) for r in requests] == [0, 1, 1]
    _, requests = play([FIRST, "WAIT(1)", "WAIT(1)"], layout="conversation", max_turns=1)
    assert [sum(PLAN in m.text for m in r.messages) for r in requests] == [0, 1, 1]


def test_a_plan_survives_a_snapshot() -> None:
    context = Context()
    context.plan = "rest"
    other = Context()
    other.restore(context.snapshot())
    assert other.plan == "rest"


@pytest.mark.parametrize("text", ["WAIT(1)", '{"action": "WAIT(1)"}', '{"plan": 3}', '{"plan": ', "Plan: ride", ""])
def test_what_is_no_plan_is_none(text: str) -> None:
    assert plan_of(text) == ""
    assert len(plan_of('{"plan": "' + "x" * 2000 + '"}')) == 500


def test_full_texts_offer_it() -> None:
    _, requests = play(["WAIT(1)"])
    assert '{"action": "WAIT(60)", "plan": "then fetch 3 and 5"}' in requests[0].messages[0].text
