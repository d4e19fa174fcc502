"""Plan-and-Solve: one plan until something calls for another, in every prompt, told of failures; both modes."""

from __future__ import annotations

import re

import pytest

from agentspec.llm.base import Request
from tests.reasoning.player import OPERATIONS, last, named, operations, play, purposes, seen, solve, solved


def planner(request: Request) -> str:
    """Plans by thinking ahead; a step takes the sub-goal it is told and reports the one before as done."""
    text = "\n".join(m.text for m in request.messages if m.role == "user")
    if request.tag.purpose == "plan":
        return "\n".join(f"{i}. {name}()" for i, name in enumerate(solve(*seen(text)) or ["ADD"], 1))
    goals = [m for m in re.findall(r"sub-goal \d+ \((.*?\))\)", text)] or re.findall(r"of the plan: (.*)\.", text)
    name = operations(goals[-1])[0]
    if request.tag.purpose == "think":
        return f"Now {name}. Sub-goal done."
    return named(name, request) if request.sampling.choices else f"Sub-goal done.\nAction: {name}()"


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("menu", [False, True])
def test_solves_what_direct_does_not(menu: bool, layout: str) -> None:
    trajectory, requests = play(planner, {"reasoning": "plan_and_solve", "layout": layout}, menu=menu)
    assert solved(trajectory)
    assert purposes(requests).count("plan") == 1
    plan = "1. SUB()\n2. DOUBLE()\n3. ADD()"
    for request in requests[1:]:
        assert "\n".join(m.text for m in request.messages).count(plan) == 1
    assert all(c.completions[0].credit == "executed" for c in trajectory.calls)


def test_conversation_stays_one_sequence() -> None:
    trajectory, _ = play(planner, {"reasoning": "plan_and_solve"}, menu=True)
    for before, after in zip(trajectory.calls, trajectory.calls[1:], strict=False):
        whole = before.prompt_ids + before.completions[0].token_ids
        assert after.prompt_ids[: len(whole)] == whole


def failing(request: Request) -> str:
    if request.tag.purpose == "plan":
        return "1. jump\n2. fly"
    return "Action: JUMP()"


def test_failures_in_a_row_lead_to_exactly_one_new_plan_that_is_told_of_them() -> None:
    spec = {"name": "plan_and_solve", "replan_failures": 2}
    _, requests = play(failing, {"reasoning": spec}, steps=4)
    assert purposes(requests) == ["plan", "act", "act", "plan", "act", "act"]
    assert "The last plan failed" in last(requests[3]) and "JUMP(): there is no action JUMP" in last(requests[3])
    assert "The last plan" not in last(requests[0])


def test_a_success_in_between_forgets_the_failures() -> None:
    answers = iter(["JUMP()", "ADD()", "JUMP()", "ADD()"])
    _, requests = play(
        lambda r: "1. try" if r.tag.purpose == "plan" else f"Action: {next(answers)}",
        {"reasoning": "plan_and_solve"},
        steps=4,
        target=1000,
    )
    assert purposes(requests).count("plan") == 1


def test_a_plan_that_is_carried_out_or_old_is_replaced() -> None:
    def done(request: Request) -> str:
        return "1. one\n2. two" if request.tag.purpose == "plan" else "Sub-goal done.\nAction: SUB()"

    _, requests = play(done, {"reasoning": "plan_and_solve"}, steps=4)
    assert purposes(requests) == ["plan", "act", "act", "plan", "act", "act"]
    assert "is carried out" in last(requests[3]) and "sub-goal 2 (two)" in last(requests[2])

    spec = {"name": "plan_and_solve", "replan_every": 1}
    _, requests = play(lambda r: "1. on" if r.tag.purpose == "plan" else "Action: SUB()", {"reasoning": spec}, steps=2)
    assert purposes(requests) == ["plan", "act", "plan", "act"]


def test_an_empty_plan_does_not_stop_it() -> None:
    trajectory, requests = play(
        lambda r: "" if r.tag.purpose == "plan" else "Action: SUB()", {"reasoning": "plan_and_solve"}
    )
    assert purposes(requests) == ["plan", "act", "act", "act"]
    assert "the task as a whole" in last(requests[1]) and trajectory.metrics["invalid_actions"] == 0


def test_rl_preset_acts_at_once_in_menu_mode() -> None:
    spec = {"name": "plan_and_solve", "preset": "rl"}
    _, requests = play(planner, {"reasoning": spec}, menu=True)
    assert purposes(requests) == ["plan", "act", "act", "act"] and requests[0].sampling.max_tokens == 96


def test_the_papers_one_call_form() -> None:
    spec = {"name": "plan_and_solve", "one_call": True}
    trajectory, requests = play(lambda r: "Plan: 1. x\nAction: SUB()", {"reasoning": spec})
    assert purposes(requests) == ["act"] * 3 and trajectory.metrics["invalid_actions"] == 0


def test_state_survives_a_snapshot() -> None:
    from agentspec.llm.recorder import Recorder
    from agentspec.llm.scripted import ScriptedLLM
    from agentspec.spec import AgentSpec

    agent = AgentSpec.from_data({"reasoning": "plan_and_solve"}).build(
        Recorder(ScriptedLLM(["x"]), episode="e", seed=0)
    )
    blob = agent.reasoning.snapshot()
    agent.reasoning._goals.append("x")
    agent.reasoning.restore(blob)
    assert agent.reasoning.snapshot() == blob
    assert set(OPERATIONS) == {"ADD", "DOUBLE", "SUB"}
