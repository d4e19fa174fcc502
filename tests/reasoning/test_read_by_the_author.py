"""Small things a method's author would miss: reasons after an action, lessons without thinking, what a trial was."""

from __future__ import annotations

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.reasoning.plan_text import goals_of, says_done
from agentspec.reasoning.search.judge import last_amount, last_number, last_word
from agentspec.reflection.trials import _steps_within
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.reasoning.player import play


def test_an_adviser_who_names_the_action_first_is_quoted_with_the_reasons() -> None:
    spec = {"reasoning": {"name": "mad", "num_agents": 2, "num_rounds": 1, "quote_tokens": 400}}
    _, requests = play(lambda r: "**Action: ADD()**\nBecause it is nearer.", spec, steps=1)
    quoted = requests[-1].messages[-1].text
    assert "Because it is nearer." in quoted and "Action: ADD()" in quoted


def test_a_goal_is_done_where_the_answer_says_so_and_not_where_it_was_thought() -> None:
    assert says_done("<think>Not yet, I should say.</think>Sub-goal done. On to the next.")
    assert not says_done("<think>Sub-goal done</think>Not there yet.")


def test_a_critic_sees_this_steps_situation_once_and_the_reasons_of_a_refinement() -> None:
    def script(request: Request) -> str:
        if request.tag.purpose == "feedback":
            return "Verdict: change\nToo greedy."
        if request.tag.purpose == "refine":
            return f"Thought: reason {len(requests)}.\nAction: {'SUB' if len(request.messages) % 2 else 'DOUBLE'}()"
        return "a thought only" if len(request.messages) == 2 else "Action: ADD()"

    requests: list[Request] = []
    spec = {"reasoning": "react", "reflection": {"name": "self_refine", "max_iterations": 2, "history_tokens": 4000}}
    _, requests[:] = play(script, spec, steps=1)
    feedback = [r for r in requests if r.tag.purpose == "feedback"]
    for request in feedback:
        shown = "\n".join(m.text for m in request.messages[1:])
        assert shown.count("The number is") == 1
    if len(feedback) > 1:
        assert "Its reasons: reason" in feedback[1].messages[-1].text


def test_the_steps_of_a_long_trial_lose_their_thoughts_before_any_is_left_out() -> None:
    def script(request: Request) -> str:
        return f"Thought: {'well ' * 20}\nAction: {['TURN_LEFT', 'TURN_RIGHT'][request.tag.step % 2]}()"

    runner = Runner(AgentSpec.from_data({"reasoning": "react"}), ScriptedLLM(script), max_steps=8)
    (trajectory,) = runner.run([Job(Task("minigrid", 1))])
    bare = _steps_within(trajectory, 400, len)
    assert len(bare) == 8 and "thought:" not in bare[0] and "thought:" in bare[-1]
    cut = _steps_within(trajectory, 120, len)
    assert cut[0].startswith("(the first ") and sum(map(len, cut[1:])) <= 120
    assert all("thought:" in line for line in _steps_within(trajectory, 10_000, len))


@pytest.mark.parametrize(
    "plan",
    [
        "1. Take order 3\n2. Fetch it",
        "Step 1: Take order 3\nStep 2: Fetch it",
        "**1. Take order 3**\n   - it pays best\n**2. Fetch it**\n   - ready in 4 min",
        "Quantities:\n- time left: 52 min\n- pay: $7\n\n**Plan**\n1) Take order 3\n2) Fetch it\n\nSo 12 min in all.",
        "Quantities\n1. time left: 52 min\n2. pay: $7\n\n## Plan:\n1. **Take order 3**\n2. Fetch it",
        "1. Take order 3\n2. Fetch it\n\nQuantities:\n1. time left: 52 min\n2. pay: $7",
        "Plan:\n- Take order 3\n- Fetch it",
    ],
)
def test_the_sub_goals_of_a_plan_are_its_steps_and_not_its_quantities(plan: str) -> None:
    assert goals_of(plan) == ["Take order 3", "Fetch it"]


def test_a_critic_sees_the_transcript_that_the_actor_saw() -> None:
    spec = {"reasoning": "react", "reflection": {"name": "self_refine"}, "layout": "snapshot", "memory": "none"}
    answers = {"act": "Thought: number it.\nAction: ADD()", "feedback": "Verdict: keep"}
    _, requests = play(lambda r: answers[r.tag.purpose], spec, steps=2)
    (first, second) = (r.messages[-1].text for r in requests if r.tag.purpose == "feedback")
    assert "Transcript so far" not in first
    assert "Thought: number it.\nAction: ADD()\nObservation:" in second and second.count("Transcript so far") == 1


def test_an_answer_that_begins_with_what_is_seen_is_not_cut_off_before_its_first_word() -> None:
    answer = "Observation: the number is low.\nThought: more.\nAction: ADD()"
    _, requests = play(lambda r: answer, {"reasoning": "react"}, steps=1)
    assert len(requests) == 1 and "Observation:" not in requests[0].sampling.stop


def test_nothing_is_no_thought() -> None:
    """An empty answer is asked for again with what is wrong; it is not acknowledged ten times."""
    answers = iter(["", "ADD()"])
    _, requests = play(lambda r: next(answers), {"reasoning": "react"}, steps=1)
    assert len(requests) == 2 and "No action could be read" in requests[1].messages[-1].text


def test_a_rating_that_was_cut_off_is_none() -> None:
    """3 stands in what there is of the reasons; an unread rating counts 0.5, not 0.3."""

    def script(request: Request) -> str:
        return "The number is 3 steps away and" if request.tag.purpose == "value" else "Thought: so.\nAction: DOUBLE()"

    small = {"num_iterations": 1, "n_generate_sample": 1, "root_samples": 1, "prediction_tokens": 16}
    trajectory, _ = play(script, {"reasoning": {"name": "lats", "preset": "rl", **small}}, steps=2)
    assert trajectory.transitions[0].decision.trace["unread_ratings"] == 1


@pytest.mark.parametrize(
    "reasoning",
    [
        {"name": "plan_and_solve", "replan_every": 4},
        {"name": "plan_and_solve", "max_goals": 3},
        {"name": "plan_and_solve", "think": False},
        {"name": "tot", "threshold": 0.9},
        {"name": "tot", "search_strategy": "DFS", "selection": "sample"},
        {"name": "tot", "temperature": 0},
        {"name": "rap", "eval_samples": 5},
        {"name": "rap", "evaluation": "samples", "reward": "normalised"},
        {"name": "rap", "temperature": 0},
    ],
)
def test_a_parameter_that_would_change_nothing_is_refused(reasoning: dict) -> None:
    with pytest.raises(SpecError, match=f"{reasoning['name']}.*(would change nothing|must be above 0)"):
        play(lambda r: "ADD()", {"reasoning": reasoning}, steps=1)


def test_a_reflector_is_told_how_the_trial_ended() -> None:
    def told(steps: int, action: str) -> str:
        asked: list[Request] = []

        def script(request: Request) -> str:
            asked.append(request)
            return action

        spec = AgentSpec.from_data({"reasoning": "direct", "reflection": "reflexion", "scope": "run"})
        Runner(spec, ScriptedLLM(script), max_steps=steps).run([Job(Task("minigrid", 1))])
        return asked[-1].messages[-1].text

    assert "It was cut off after step 3." in told(3, "TURN_LEFT()")
    assert "It ended with step 1, without success." in told(3, "TOGGLE()")


def test_a_judge_sees_first_what_a_tried_action_did_and_something_of_every_paragraph() -> None:
    """A refused action changes nothing that a clipped observation shows; why it was refused stands at its end."""
    asked: list[Request] = []

    def script(request: Request) -> str:
        asked.append(request)
        return "Rating: 2" if request.tag.purpose == "value" else "Thought: so.\nAction: RENT_CAR()"

    small = {"num_iterations": 1, "n_generate_sample": 1, "root_samples": 1, "path_tokens": 400}
    spec = AgentSpec.from_data({"reasoning": {"name": "lats", "preset": "rl", **small}})
    Runner(spec, ScriptedLLM(script), max_steps=1).run([Job(Task("deliverybench", 0, {"size": "tiny"}))])
    course = next(r for r in asked if r.tag.purpose == "value").messages[-1].text.partition("Steps tried")[2]
    assert "-> there is no car rental within 5m" in course
    assert "Your orders: none" in course and "Around you" in course and " ..." in course


@pytest.mark.parametrize(
    ("answer", "rating"),
    [("Rating: 8 (of 1-10)", 8), ("**Rating:** 7\nThere are 3 orders.", 7), ("The best one is 2, not 3.", 2), ("4", 4)],
)
def test_the_number_that_is_called_the_rating_counts(answer: str, rating: int) -> None:
    assert last_number(answer, range(1, 11)) == rating


def test_a_denied_word_is_no_judgement_and_a_thousand_is_one() -> None:
    values = {"sure": 20.0, "likely": 1.0, "impossible": 0.001}
    assert last_word("It is likely, but I am not sure.", values) == 1.0
    assert last_word("That isn't impossible.", values) is None
    assert last_word("Not sure at first; but yes: sure", values) == 20.0
    assert last_amount("Estimate: $1,200", "estimate") == 1200.0
    assert last_amount("Estimate: 12,50", "estimate") == 12.5
