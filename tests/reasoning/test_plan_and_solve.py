"""Plan-and-Solve: one plan until something calls for another, in every prompt, told of failures; both modes."""

from __future__ import annotations

import asyncio
import dataclasses
import re

import pytest

from agentspec.llm.base import Request
from agentspec.llm.recorder import Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.reasoning.plan_text import says_done
from agentspec.spec import AgentSpec
from agentspec.types import Action, ActionSchema, AgentInput, Decision, Transition
from tests.reasoning.player import OPERATIONS, last, named, operations, play, purposes, seen, solve, solved

PERSISTENT = {"name": "plan_and_solve", "persistent": True}


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
    trajectory, requests = play(planner, {"reasoning": PERSISTENT, "layout": layout}, menu=menu)
    assert solved(trajectory)
    assert purposes(requests).count("plan") == 1
    plan = "1. SUB()\n2. DOUBLE()\n3. ADD()"
    for request in requests[1:]:
        assert "\n".join(m.text for m in request.messages).count(plan) == 1
    assert all(c.completions[0].credit == "executed" for c in trajectory.calls)


def test_conversation_stays_one_sequence() -> None:
    trajectory, _ = play(planner, {"reasoning": PERSISTENT}, menu=True)
    for before, after in zip(trajectory.calls, trajectory.calls[1:], strict=False):
        whole = before.prompt_ids + before.completions[0].token_ids
        assert after.prompt_ids[: len(whole)] == whole


def failing(request: Request) -> str:
    if request.tag.purpose == "plan":
        return "1. jump\n2. fly"
    return "Action: JUMP()"


def test_failures_in_a_row_lead_to_exactly_one_new_plan_that_is_told_of_them() -> None:
    spec = {**PERSISTENT, "replan_failures": 2, "max_retries": 0}
    _, requests = play(failing, {"reasoning": spec}, steps=4)
    assert purposes(requests) == ["plan", "act", "act", "plan", "act", "act"]
    assert "The last plan failed" in last(requests[3]) and "JUMP(): there is no action JUMP" in last(requests[3])
    assert "The last plan" not in last(requests[0])


def test_a_success_in_between_forgets_the_failures() -> None:
    answers = iter(["JUMP()", "ADD()", "JUMP()", "ADD()"])
    _, requests = play(
        lambda r: "1. try" if r.tag.purpose == "plan" else f"Action: {next(answers)}",
        {"reasoning": {**PERSISTENT, "max_retries": 0}},
        steps=4,
        target=1000,
    )
    assert purposes(requests).count("plan") == 1


def test_a_plan_that_is_carried_out_or_old_is_replaced() -> None:
    def done(request: Request) -> str:
        return "1. one\n2. two" if request.tag.purpose == "plan" else "Sub-goal done.\nAction: SUB()"

    _, requests = play(done, {"reasoning": PERSISTENT}, steps=4)
    assert purposes(requests) == ["plan", "act", "act", "plan", "act", "act"]
    assert "is carried out" in last(requests[3]) and "sub-goal 2 (two)" in last(requests[2])

    spec = {**PERSISTENT, "replan_every": 1}
    _, requests = play(lambda r: "1. on" if r.tag.purpose == "plan" else "Action: SUB()", {"reasoning": spec}, steps=2)
    assert purposes(requests) == ["plan", "act", "plan", "act"]


def test_an_empty_plan_does_not_stop_it() -> None:
    trajectory, requests = play(lambda r: "" if r.tag.purpose == "plan" else "Action: SUB()", {"reasoning": PERSISTENT})
    assert purposes(requests) == ["plan", "act", "act", "act"]
    assert "the task as a whole" in last(requests[1]) and trajectory.metrics["invalid_actions"] == 0


def test_rl_preset_acts_at_once_in_menu_mode() -> None:
    spec = {"name": "plan_and_solve", "preset": "rl"}
    _, requests = play(planner, {"reasoning": spec}, menu=True)
    assert purposes(requests) == ["plan", "act", "act", "act"] and requests[0].sampling.max_tokens == 96


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
def test_plan_and_solution_together_is_the_default(layout: str) -> None:
    def both(request: Request) -> str:
        text = "\n".join(m.text for m in request.messages if m.role == "user")
        (first, *_) = solve(*seen(text)) or ["ADD"]
        if request.sampling.choices:
            return named(first, request)
        return f"Plan:\n1. {first}()\n2. and on\n" + ("" if request.tag.purpose == "think" else f"Action: {first}()")

    trajectory, requests = play(both, {"reasoning": "plan_and_solve", "layout": layout})
    assert purposes(requests) == ["act"] * 3 and solved(trajectory)
    assert "devise a plan" in requests[0].messages[0].text and requests[0].sampling.max_tokens >= 1024
    assert "Plan:" in trajectory.transitions[0].decision.rationale
    trajectory, requests = play(both, {"reasoning": "plan_and_solve", "layout": layout}, menu=True)
    assert purposes(requests) == ["think", "act"] * 3 and solved(trajectory)
    assert "2. and on" not in "".join(m.text for m in requests[2].messages)  # anew at every step


@pytest.mark.parametrize(
    ("words", "done"),
    [
        ("Sub-goal done.", True),
        ("The order is in the bag. Sub-goal 1 is done.", True),
        ("Sub-goal done? No, not yet.", False),
        ("Is sub-goal 1 done? No.", False),
        ("Sub-goal not done.", False),
        ("The sub-goal is not yet done.", False),
        ("I will write 'Sub-goal done' when I arrive.", False),
        ("Once sub-goal done, go on.", False),
        ("Sub-goal done yet? Hardly.", False),
        ("<think>Sub-goal done</think>On my way.", False),
    ],
)
def test_only_a_report_moves_the_plan_on(words: str, done: bool) -> None:
    assert says_done(words) is done


def test_news_calls_for_a_new_plan_and_nothing_to_see_for_none() -> None:
    from agentspec.reasoning.plan_and_solve import something_to_see

    assert something_to_see({"number": 3}) and something_to_see({"offers": [1], "orders": []})
    assert not something_to_see({"offers": [], "orders": []})
    agent = AgentSpec.from_data({"reasoning": PERSISTENT}).build(Recorder(ScriptedLLM(["x"]), episode="e", seed=0))
    method, seen_ = agent.reasoning, AgentInput("", "", ActionSchema({}), {"offers": [], "orders": []})
    assert method._reason_to_plan(seen_) is None  # step 0: the board has not been read
    assert method._reason_to_plan(dataclasses.replace(seen_, state={"offers": [1], "orders": []})) == ""
    method._plan, method._goals = "1. a", ["a"]
    assert method._reason_to_plan(seen_) is None
    step = Transition(0, seen_, Decision(Action("A", text="A()")), "A()", 0.0, "", info={"events": ["delivered"]})
    asyncio.run(method.observe(step))
    assert method._reason_to_plan(seen_) == "was made before this: delivered"
    quiet = dataclasses.replace(step, info={"events": ["bagged"]})
    method._news = ""
    asyncio.run(method.observe(quiet))
    assert method._reason_to_plan(seen_) is None


def test_state_survives_a_snapshot() -> None:
    agent = AgentSpec.from_data({"reasoning": PERSISTENT}).build(Recorder(ScriptedLLM(["x"]), episode="e", seed=0))
    blob = agent.reasoning.snapshot()
    agent.reasoning._goals.append("x")
    agent.reasoning.restore(blob)
    assert agent.reasoning.snapshot() == blob
    assert set(OPERATIONS) == {"ADD", "DOUBLE", "SUB"}


def test_to_have_come_where_one_wanted_to_go_is_no_news() -> None:
    agent = AgentSpec.from_data({"reasoning": PERSISTENT}).build(Recorder(ScriptedLLM(["x"]), episode="e", seed=0))
    method, here = agent.reasoning, AgentInput("", "", ActionSchema({}), {"offers": [1]})
    method._plan, method._goals = "1. a", ["a"]
    for event, due in (("arrived", False), ("picked_up", False), ("new_offers", True), ("hospital", True)):
        method._news = ""
        decision = Decision(Action("A", text="A()"))
        asyncio.run(method.observe(Transition(0, here, decision, "A()", 0.0, "", info={"events": [event]})))
        assert (method._reason_to_plan(here) is not None) is due, event
