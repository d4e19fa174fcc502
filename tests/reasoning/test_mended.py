"""What the methods' papers do and an agent must not lose: votes, whole actions under judgement, scales."""

from __future__ import annotations

import re

import pytest

from agentspec.actions import parse_action
from agentspec.context import Context
from agentspec.llm.base import Request
from agentspec.llm.recorder import ModuleLLM, Recorder
from agentspec.llm.scripted import ScriptedLLM
from agentspec.prompting import Step, course, quote
from agentspec.reasoning.self_consistency import Tally, Vote
from agentspec.registry import SpecError
from agentspec.services import Services, StepClock
from agentspec.types import ActionSchema, ActionSpec, Parameter
from tests.reasoning.numbers_env import NUMBERS, NumbersEnv
from tests.reasoning.player import OPERATIONS, last, named, play, purposes, seen, solved
from tests.reasoning.test_rap import imaginer, nearness

MOVES = ActionSchema(
    {
        "MOVE": ActionSpec(
            "MOVE",
            parameters={
                "x": Parameter("float", resolution=1.0),
                "y": Parameter("float", resolution=1.0),
                "pace": Parameter("str", required=False, default="normal"),
            },
        ),
        "VIEW_ORDERS": ActionSpec("VIEW_ORDERS"),
    }
)


def services() -> Services:
    import random

    recorder = Recorder(ScriptedLLM(["x"]), episode="e", seed=0)
    return Services(ModuleLLM(recorder, "reasoning.x"), Context(), StepClock(), random.Random(0))


def test_three_spellings_of_one_move_outvote_two_looks_at_the_board() -> None:
    texts = [
        "VIEW_ORDERS()",
        "MOVE(120, -48)",
        "VIEW_ORDERS()",
        'MOVE(x=120.2, y=-48, pace="normal")',
        "MOVE(120.0, -48.1)",
    ]
    votes = [Vote(parse_action(text, MOVES), text, ((i, 0),)) for i, text in enumerate(texts)]
    tally = Tally.of(votes, MOVES)
    assert tally.winner.action.name == "MOVE" and [len(g) for g in tally.groups] == [3, 2]


def test_a_quotation_keeps_the_action_whatever_is_cut() -> None:
    action = parse_action("MOVE(120, -48)", MOVES)
    text = "<think>secret</think>" + "a long reason. " * 100 + "\n**Action:** `MOVE(120, -48)`\nObservation: made up"
    for budget in (10, 60, 200, 5000):
        shown = quote(text, action, budget, services())
        assert shown.endswith("Action: MOVE(120, -48)") and "secret" not in shown and "made up" not in shown
        assert len(shown) <= max(budget, len("Action: MOVE(120, -48)"))  # the scripted model counts bytes


def test_advisers_see_each_others_actions_whatever_the_length() -> None:
    def wordy(request: Request) -> str:
        return f"{'because of this and that, ' * 30}\nAction: {('ADD', 'SUB', 'DOUBLE')[request.id % 3]}()"

    _, requests = play(wordy, {"reasoning": "mad"}, steps=1)
    later = [r for r in requests if r.id >= 3]
    assert later and all(len(re.findall(r"Action: (?:ADD|SUB|DOUBLE)\(\)", last(r))) == 2 for r in later)
    assert "your own" in last(later[0])
    assert {r.sampling.temperature for r in requests} == {0.7}


def test_copies_of_one_greedy_agent_are_no_debate() -> None:
    with pytest.raises(SpecError, match="mad: sampling_temperature must be above 0"):
        play(lambda r: "ADD()", {"reasoning": {"name": "mad", "sampling_temperature": 0.0}})


class Rigid(ScriptedLLM):
    """An endpoint that does not let itself be told a temperature, which it says when first asked."""

    async def generate(self, request):
        self.rejected = {"temperature": "Unsupported parameter: temperature"}
        return await super().generate(request)


@pytest.mark.parametrize("method", ["self_consistency", "mad"])
def test_votes_without_a_temperature_are_refused_with_the_reason(method: str) -> None:
    from agentspec.episode import Job, Runner
    from agentspec.spec import AgentSpec
    from agentspec.types import Task

    with pytest.raises(SpecError, match=r"Unsupported parameter.*choose a method of one answer"):
        Runner(AgentSpec.from_data({"reasoning": method}), Rigid(lambda r: "ADD()")).run([Job(Task(NUMBERS, 0))])


# -- courses under judgement ----------------------------------------------------------------------------------------


def test_a_course_keeps_every_action_and_thought() -> None:
    steps = [Step(f"A{i}()", f"thought-{i}", f"seen-{i} " + "word " * 200) for i in range(5)]
    for budget in (0, 100, 400, 2000):
        text = course(steps, budget, services())
        assert all(f"A{i}()" in text and f"thought-{i}" in text for i in range(5))
        assert len(text) <= max(budget, len(course([Step(s.action, s.thought) for s in steps], 0, services()))) + 5 * 4
    assert "seen-4" in course(steps, 400, services())  # the newest is seen first


def test_the_lats_judge_sees_the_course_it_rates() -> None:
    class Wordy(NumbersEnv):
        pass

    def script(request: Request):
        if request.tag.purpose == "propose":
            return [f"Thought: thought of {n}\nAction: {n}()" for n in OPERATIONS][: request.sampling.n]
        return "5" if request.tag.purpose == "value" else "no"

    spec = {"name": "lats", "preset": "rl", "path_tokens": 16}
    _, requests = play(script, {"reasoning": spec}, target=1000, steps=5)
    rated = [last(r).split("Steps tried in thought")[-1] for r in requests if r.tag.purpose == "value"]
    assert rated
    for text in rated:
        actions = re.findall(r"^\d+\. (\w+)\(\)", text, re.MULTILINE)
        thoughts = re.findall(r"thought of (\w+)", text)
        assert actions and actions == thoughts


def test_lats_does_not_take_a_dollar_for_success(monkeypatch: pytest.MonkeyPatch) -> None:
    # The environment declares that a good episode returns 20: a reward of 1 is 0.05, and no success by itself.
    monkeypatch.setitem(NumbersEnv.metadata, "typical_return", 20.0)
    from agentspec.spec import AgentSpec
    from agentspec.types import Task

    agent = AgentSpec.from_data({"reasoning": "lats"}).build(Recorder(ScriptedLLM(["x"]), episode="e", seed=0))
    agent.reasoning.services.simulator = object()
    agent.reasoning.begin_episode(Task(NUMBERS, 0))
    assert agent.reasoning.reward_scale == 0.05 and agent.reasoning.success_return == 20.0
    given = AgentSpec.from_data({"reasoning": {"name": "lats", "reward_scale": 1.0, "success_return": 1.0}})
    agent = given.build(Recorder(ScriptedLLM(["x"]), episode="e", seed=0))
    agent.reasoning.services.simulator = object()
    agent.reasoning.begin_episode(Task(NUMBERS, 0))
    assert (agent.reasoning.reward_scale, agent.reasoning.success_return) == (1.0, 1.0)


# -- tree of thoughts -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "answer",
    [
        "1. `ADD()`\n2. `DOUBLE()`\n3. `SUB()`",
        "- **ADD()** - adds three\n- **DOUBLE()** (twice)\n- **SUB()**: one less",
        "Here are three:\n\n1) ADD() # first\n2) DOUBLE()\n3) SUB()",
        "<think>SUB()</think>\nADD()\nDOUBLE()\nSUB()",
        '{"action": "ADD()"}\n{"action": "DOUBLE()"}\n{"action": "SUB()"}',
        "Action: ADD()\nAction: DOUBLE()\nAction: SUB()",
    ],
)
def test_proposals_are_read_in_any_dress(answer: str) -> None:
    def script(request: Request) -> str:
        return answer if request.tag.purpose == "propose" else "likely"

    trajectory, _ = play(script, {"reasoning": "tot"}, steps=5)
    assert trajectory.transitions[0].decision.trace["layers"] == [3, 6, 6]


def test_estimates_weigh_amounts_by_how_sure_they_are() -> None:
    said = {"ADD": "Estimate: about $40\nimpossible", "DOUBLE": "Estimate: 6.5\nsure", "SUB": "Estimate: 12\nlikely"}

    def script(request: Request) -> str:
        if request.tag.purpose == "propose":
            return "ADD()\nDOUBLE()\nSUB()"
        return next(text for name, text in said.items() if f"1. {name}()" in last(request))

    spec = {"name": "tot", "evaluation_strategy": "estimate", "evaluations": 1, "depth": 2, "breadth": 1}
    trajectory, _ = play(script, {"reasoning": spec}, steps=1)
    # 40 * 0, 6.5 * 1, 12 * 0.5
    assert dict(trajectory.transitions[0].decision.candidates) == {"ADD()": 0.0, "DOUBLE()": 6.5, "SUB()": 6.0}


# -- RAP ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reward", ["paper", "normalised"])
def test_dying_early_does_not_win(reward: str) -> None:
    """ADD ends it all without success; DOUBLE goes on. Each step costs the same log-probability."""

    def script(request: Request):
        if request.tag.purpose == "propose":
            return [named(name, request) for name in ("ADD", "DOUBLE")]
        course_ = last(request).split("Steps tried")[-1]
        return "It is over.\nEarned: 0\nGoal: over" if "ADD()" in course_ else "On.\nEarned: 0\nGoal: no"

    spec = {"name": "rap", "num_actions": 2, "num_iterations": 60, "depth": 3, "exploration": 5.0, "reward": reward}
    trajectory, _ = play(script, {"reasoning": spec}, score=lambda m, c: -1.0, steps=1)
    assert trajectory.transitions[0].decision.action.name == "DOUBLE"


def test_predicted_earnings_count() -> None:
    def script(request: Request):
        if request.tag.purpose == "propose":
            return [named(name, request) for name in ("ADD", "SUB")]
        return f"On.\nEarned: ${0.5 if 'SUB()' in last(request).split('Steps tried')[-1] else 0}\nGoal: no"

    spec = {"name": "rap", "num_actions": 2, "num_iterations": 6, "depth": 1, "exploration": 9.0}
    trajectory, _ = play(script, {"reasoning": spec}, score=lambda m, c: -1.0, steps=1)
    values = dict(trajectory.transitions[0].decision.candidates)
    # fast = 0.5 * (-1 - 1) = -1; $0.5 of a typical return of 1 is half the goal's reward: 0.5 * 100 * 0.5 = 25.
    assert values["SUB()"] == pytest.approx(24.0) and values["ADD()"] == pytest.approx(-1.0)
    assert trajectory.transitions[0].decision.action.name == "SUB"


def test_long_calls_are_not_the_worse_ones_for_their_length() -> None:
    def per_byte(messages, continuation: str) -> float:
        return 0.0 if continuation == "good" else -1.0 * len(continuation)

    spec = {"name": "rap", "num_iterations": 1, "depth": 1, "reward": "normalised"}
    trajectory, _ = play(imaginer, {"reasoning": spec}, score=per_byte)
    values = dict(trajectory.transitions[0].decision.candidates)
    assert values["ADD()"] == values["DOUBLE()"] == pytest.approx(-0.5)  # 0.5 * (-1 per token + 0)
    spec = {"name": "rap", "num_iterations": 1, "depth": 1}
    values = dict(play(imaginer, {"reasoning": spec}, score=per_byte)[0].transitions[0].decision.candidates)
    assert values["DOUBLE()"] == pytest.approx(-4.0) and nearness is not None


# -- ReAct ----------------------------------------------------------------------------------------------------------


def test_react_shows_every_step_once() -> None:
    agent = {"reasoning": "react", "memory": "base", "layout": "snapshot"}
    _, requests = play(lambda r: f"Thought: unique-{r.tag.step}\nAction: SUB()", agent)
    prompt = last(requests[-1])
    assert prompt.count("SUB()") == 2 and prompt.count("unique-0") == 1 and "Memory" not in prompt
    assert prompt.index("Transcript") < prompt.index("The number is")


def test_react_asks_again_as_often_as_it_says() -> None:
    """An action that cannot be read is no thought, also when there are no more retries."""
    agent = {"reasoning": {"name": "react", "max_retries": 2}}
    trajectory, _ = play(lambda r: "Thought: there is more.\nAction: SUB(3, 4, 5x)", agent, steps=1)
    assert [c.tag.purpose for c in trajectory.calls] == ["act"] * 3
    assert not trajectory.transitions[0].decision.valid


def test_react_does_not_take_a_bare_call_for_a_thought() -> None:
    trajectory, requests = play(lambda r: "SUB()", {"reasoning": "react"}, steps=2)
    assert purposes(requests) == ["act", "act"] and not solved(trajectory)


def test_seen_is_the_players_eye() -> None:
    assert seen("The number is 3. The target is 7. There are 2 steps left") == (3, 7, 2)
