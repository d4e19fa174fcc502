"""Multi-agent debate: private dialogues, simultaneous rounds, exact counts, votes and ties; both modes."""

from __future__ import annotations

import re

import pytest

from agentspec.llm.base import Request
from tests.reasoning.numbers_env import OPERATIONS
from tests.reasoning.player import credits_of, last, named, operations, play, purposes, seen, solve, solved


def whole(request: Request) -> str:
    return "\n".join(m.text for m in request.messages)


def debater(request: Request):
    """Adviser 3 alone finds the way in round 0; whoever is shown an answer that works takes it over."""
    number, target, left = seen("\n".join(m.text for m in request.messages if m.role == "user"))
    quoted = [o for t in re.findall(r"Adviser \d: .*", last(request)) for o in operations(t)[-1:]]
    own = [o for m in request.messages if m.role == "assistant" for o in operations(m.text)[-1:]]

    def works(name: str) -> bool:
        n = OPERATIONS[name](number)
        return n == target or solve(n, target, left - 1) is not None

    best = next((name for name in [*own[-1:], *quoted] if works(name)), None)
    if best is None:
        lucky = request.id % 3 == 2
        best = (solve(number, target, left) or ["ADD"])[0] if lucky else "ADD"
    if request.sampling.choices:
        return named(best, request)
    return f"It is {best}().\nAction: {best}()" if request.tag.purpose == "act" else f"I favour {best}()."


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
def test_solves_what_direct_does_not(layout: str) -> None:
    trajectory, requests = play(debater, {"reasoning": "mad", "layout": layout})
    assert solved(trajectory)
    assert len(requests) == 9 * len(trajectory.transitions)
    trace = trajectory.transitions[0].decision.trace
    # Round 0: ADD, ADD, SUB. In round 1 the others see SUB work; 3:0 in the last round.
    assert trace["rounds"] == [["ADD()", "ADD()", "SUB()"], ["SUB()"] * 3, ["SUB()"] * 3] and trace["votes"] == [3]
    assert credits_of(trajectory, "act")[:9] == ["explored"] * 6 + ["executed"] + ["explored"] * 2


def answers_by_number(request: Request) -> str:
    """Every answer is unique: who said what, and who may have seen it, shows in the prompts."""
    if request.sampling.choices:
        return request.sampling.choices[0]
    return f"answer-{request.id}\nAction: ADD()"


def test_messages_are_isolated_and_rounds_simultaneous() -> None:
    _, requests = play(answers_by_number, {"reasoning": "mad"}, steps=1)
    assert len(requests) == 9
    for request in requests:
        round_, agent = divmod(request.id, 3)
        seen_now = set(map(int, re.findall(r"answer-(\d+)", last(request))))
        before = set(map(int, re.findall(r"answer-(\d+)", whole(request))))
        # Shown in round r: the other agents' answers of round r-1, and no others; nothing in round 0.
        others = {3 * (round_ - 1) + a for a in range(3) if a != agent} if round_ else set()
        assert seen_now == others
        own = {3 * r + agent for r in range(round_)}
        earlier = {3 * (r - 1) + a for r in range(1, round_ + 1) for a in range(3) if a != agent}
        assert before == own | earlier


def test_a_lone_agent_checks_its_own_answer() -> None:
    spec = {"name": "mad", "num_agents": 1, "num_rounds": 1}
    _, requests = play(answers_by_number, {"reasoning": spec}, steps=1)
    assert len(requests) == 2 and "Check your answer" in last(requests[1]) and "Adviser" not in last(requests[1])


def test_ties_go_to_the_first_and_illegal_answers_do_not_vote() -> None:
    answers = iter(["DOUBLE()", "ADD()", "hm", "SUB()", "ADD()", "hm"])
    spec = {"reasoning": {"name": "mad", "num_rounds": 1, "max_retries": 0}}
    trajectory, _ = play(lambda r: f"Action: {next(answers)}", spec, steps=1)
    assert trajectory.transitions[0].action_text == "SUB()"  # 1:1 in the last round
    assert trajectory.transitions[0].decision.valid


def test_an_illegal_last_round_falls_back_flagged() -> None:
    answers = iter(["Action: DOUBLE()", "x", "x", "x", "x", "x"])
    spec = {"reasoning": {"name": "mad", "num_rounds": 1, "max_retries": 0}}
    trajectory, _ = play(lambda r: next(answers), spec, steps=1)
    decision = trajectory.transitions[0].decision
    assert decision.action.name == "DOUBLE" and not decision.valid and "round 0" in decision.trace["fallback"]


@pytest.mark.parametrize(("preset", "calls"), [("paper", 18), ("rl", 4)])
def test_menu_argues_then_chooses_under_constraint(preset: str, calls: int) -> None:
    trajectory, requests = play(debater, {"reasoning": {"name": "mad", "preset": preset}}, menu=True)
    assert len(requests) == calls * len(trajectory.transitions)
    assert all(bool(r.sampling.choices) == (r.tag.purpose == "act") for r in requests)
    if preset == "paper":
        assert solved(trajectory)
        assert purposes(requests)[:6] == ["argue"] * 3 + ["act"] * 3
        # Arguments are quoted to the others, with the choice they led to.
        assert "I favour" in last(requests[6]) and "Action: " in last(requests[6])


def test_a_budget_in_mid_debate_votes_on_what_was_said() -> None:
    trajectory, _ = play(debater, {"reasoning": "mad", "budget": {"calls": 5}})
    decision = trajectory.transitions[0].decision
    # Round 0: ADD ADD SUB; round 1 ends after two agents, who now say SUB: SUB SUB and the third's SUB.
    assert decision.action.name == "SUB" and decision.valid and decision.trace["exhausted"] == "episode"
