"""Small things a method's author would miss: reasons after an action, lessons without thinking, what a trial was."""

from __future__ import annotations

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.reasoning.plan_and_solve import says_done
from agentspec.reflection.trials import _steps_within
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
