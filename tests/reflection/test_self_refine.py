"""Self-Refine: it stops, keeps its history, ignores what is no action, repairs what is illegal; credit moves."""

from __future__ import annotations

import re

import pytest

from agentspec.llm.base import Request
from tests.reasoning.player import (
    OPERATIONS,
    credits_of,
    greedy_player,
    last,
    named,
    operations,
    play,
    purposes,
    seen,
    solve,
    solved,
)


def spec(**params) -> dict:
    return {"reasoning": "direct", "reflection": {"name": "self_refine", **params}}


def critical(request: Request) -> str:
    """Acts greedily; the critic plays the candidate out; the refiner does what the critic names."""
    if request.tag.purpose == "act":
        return greedy_player(request)
    number, target, left = seen(last(request))
    if request.tag.purpose == "feedback":
        (*_, attempt) = re.findall(r"Attempt \d+: (.*)", last(request))
        (name, *_) = operations(attempt) or ["none"]
        way = solve(number, target, left) or []
        if not way or (name in OPERATIONS and (OPERATIONS[name](number), name)[1] == way[0]):
            return "Good.\nVerdict: keep"
        return f"That leads nowhere; {way[0]}() would.\nVerdict: change"
    (*_, feedback) = re.findall(r"Feedback on attempt \d+: (.*)", last(request))
    return named(operations(feedback)[-1], request)


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("menu", [False, True])
def test_solves_what_direct_does_not(menu: bool, layout: str) -> None:
    assert not solved(play(greedy_player, {"reasoning": "direct"}, menu=menu)[0])
    trajectory, requests = play(critical, {**spec(), "layout": layout}, menu=menu)
    assert solved(trajectory)
    assert trajectory.transitions[0].decision.trace["refined_from"] in ("ADD()", "add three")
    # Step 1: greedy ADD is replaced by SUB. Credit moves from the first answer to the refined one.
    assert credits_of(trajectory, "act")[0] == "explored" and credits_of(trajectory, "refine")[0] == "executed"
    assert set(credits_of(trajectory, "feedback")) == {"aux"}
    refine = next(r for r in requests if r.tag.purpose == "refine")
    assert bool(refine.sampling.choices) == menu


def test_a_content_critic_costs_one_call_and_changes_nothing() -> None:
    trajectory, requests = play(
        lambda r: "Fine. Verdict: keep" if r.tag.purpose == "feedback" else "SUB()", spec(), steps=1
    )
    assert purposes(requests) == ["act", "feedback"]
    decision = trajectory.transitions[0].decision
    assert decision.action.text == "SUB()" and decision.trace["refining_ended"] == "kept"
    assert credits_of(trajectory, "act") == ["executed"]


def scripted(feedback: list[str], refinements: list[str], first: str = "ADD()"):
    answers = {"feedback": iter(feedback), "refine": iter(refinements), "act": iter([first])}
    return lambda r: next(answers[r.tag.purpose])


def test_the_whole_history_is_shown() -> None:
    trajectory, requests = play(
        scripted(["Verdict: change\nbad-one", "bad-two. Verdict: change", "Verdict: keep"], ["SUB()", "DOUBLE()"]),
        spec(),
        steps=1,
    )
    assert purposes(requests) == ["act", "feedback", "refine", "feedback", "refine", "feedback"]
    history = last(requests[-1])
    order = ["Attempt 1: ADD()", "bad-one", "Attempt 2: SUB()", "bad-two", "Attempt 3: DOUBLE()"]
    places = [history.index(text) for text in order]
    assert places == sorted(places)
    assert trajectory.transitions[0].action_text == "DOUBLE()"
    assert credits_of(trajectory, "refine") == ["explored", "executed"]


def test_an_illegal_refinement_is_ignored() -> None:
    trajectory, requests = play(scripted(["Verdict: change\nbad", "Verdict: keep"], ["JUMP()"]), spec(), steps=1)
    assert trajectory.transitions[0].action_text == "ADD()" and trajectory.transitions[0].decision.valid
    assert "'JUMP()', which is not possible" in last(requests[-1])
    assert credits_of(trajectory, "act") == ["executed"] and credits_of(trajectory, "refine") == ["explored"]


def test_the_same_action_again_ends_it() -> None:
    trajectory, requests = play(scripted(["Verdict: change bad"], ["add( )"]), spec(), steps=1)
    assert purposes(requests) == ["act", "feedback", "refine"]
    assert trajectory.transitions[0].decision.trace["refining_ended"] == "unchanged"


GIVES_UP = {**spec(), "reasoning": {"name": "direct", "max_retries": 0}}


def test_an_illegal_first_action_is_repaired() -> None:
    trajectory, requests = play(
        scripted(["Verdict: change\nJUMP is unknown", "Verdict: keep"], ["SUB()"], "JUMP()"), GIVES_UP, steps=1
    )
    assert "there is no action JUMP" in last(requests[1])
    assert trajectory.transitions[0].decision.valid and trajectory.metrics["invalid_actions"] == 0


def test_a_budget_keeps_the_decision_flagged() -> None:
    trajectory, _ = play(scripted(["Verdict: change bad"], []), {**spec(), "budget": {"calls": 2}}, steps=1)
    decision = trajectory.transitions[0].decision
    assert decision.action.text == "ADD()" and decision.valid and decision.trace["exhausted"] == "episode"


def test_a_plan_keeps_its_credit() -> None:
    def script(request: Request) -> str:
        answers = {"plan": "1. add", "act": "Action: ADD()", "feedback": "Verdict: change", "refine": "SUB()"}
        return answers[request.tag.purpose]

    trajectory, _ = play(
        script, {**spec(preset="rl"), "reasoning": {"name": "plan_and_solve", "persistent": True}}, steps=1
    )
    assert trajectory.transitions[0].action_text == "SUB()"
    assert [c.completions[0].credit for c in trajectory.calls] == ["executed", "explored", "aux", "executed"]


def test_a_missing_verdict_asks_for_no_change() -> None:
    trajectory, requests = play(scripted(["Looks reasonable to me."], []), spec(), steps=1)
    assert purposes(requests) == ["act", "feedback"]
    assert trajectory.transitions[0].decision.trace["refining_ended"] == "no verdict"


def test_a_long_feedback_does_not_cut_the_verdict() -> None:
    def critic(request: Request) -> str:
        return f"Verdict: change\n{'too slow ' * 500}" if request.tag.purpose == "feedback" else "SUB()"

    _, requests = play(critic, spec(max_iterations=1), steps=1)
    assert purposes(requests) == ["act", "feedback", "refine"]
    assert "Verdict: keep" in last(requests[1]) and last(requests[1]).index("Begin with") > 0


def test_the_critic_sees_reasons_conversation_and_memory() -> None:
    def script(request: Request) -> str:
        if request.tag.purpose == "feedback":
            return "Verdict: keep"
        return f"Thought: reason-{request.tag.step}\nAction: SUB()"

    memory = "tests.test_seams:Diary"  # one that repeats what the conversation holds
    agent = {"reasoning": "react", "memory": memory, **{k: v for k, v in spec().items() if k != "reasoning"}}
    _, requests = play(script, agent)
    critic = [r for r in requests if r.tag.purpose == "feedback"][-1]
    assert "Its reasons:" in last(critic) and "reason-2" in last(critic)  # of the action under judgement
    assert "reason-0" in "".join(m.text for m in critic.messages[:-1])  # the conversation
    assert "1. SUB()" in last(critic)  # memory


def test_the_refined_rationale_replaces_the_old_one() -> None:
    answers = {
        "act": "Thought: old\nAction: ADD()",
        "feedback": "Verdict: change",
        "refine": "new reason\nAction: SUB()",
    }
    agent = {"reasoning": "react", **{k: v for k, v in spec(max_iterations=1).items() if k != "reasoning"}}
    trajectory, _ = play(lambda r: answers[r.tag.purpose], agent, steps=1)
    decision = trajectory.transitions[0].decision
    assert decision.action.name == "SUB" and decision.rationale == "new reason"


def test_equal_actions_written_otherwise_are_unchanged() -> None:
    trajectory, _ = play(scripted(["Verdict: change"], ["I would say:\n**Action:** `add()`"]), spec(), steps=1)
    assert trajectory.transitions[0].decision.trace["refining_ended"] == "unchanged"
