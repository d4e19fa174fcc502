"""What each reasoner must not lose, with scripted models."""

from __future__ import annotations

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.toy_env import TOY


def play(script, spec: dict, **options) -> tuple[Trajectory, list[Request]]:
    seen: list[Request] = []

    def spy(request: Request):
        seen.append(request)
        return script(request)

    (trajectory,) = Runner(AgentSpec.from_data(spec), ScriptedLLM(spy)).run([Job(Task(TOY, 0, options))])
    return trajectory, seen


def test_direct_sees_actions_and_memory() -> None:
    trajectory, seen = play(
        lambda r: "WAIT()", {"reasoning": "direct", "memory": {"name": "base", "window": 2}, "layout": "snapshot"}
    )
    assert "SELL()" in seen[0].messages[0].text and "WAIT()" in seen[0].messages[0].text
    last = seen[-1].messages[-1].text
    # Window 2: of the four earlier steps the last two, oldest first.
    assert "2. WAIT()" not in last and last.index("3. WAIT()") < last.index("4. WAIT()") < last.rindex("The price is")
    assert all(d.decision.rationale == "" for d in trajectory.transitions)
    assert {r.messages[0].text for r in seen} == {seen[0].messages[0].text}  # static text first, the same every step


def test_cot_takes_the_last_action_line_and_does_not_carry_the_chain() -> None:
    chain = "Maybe Action: WAIT()\nno, the price is high.\nAction: SELL()"
    trajectory, seen = play(lambda r: chain, {"reasoning": "cot"})
    assert [t.action_text for t in trajectory.transitions] == ["SELL()"] * 5
    assert trajectory.transitions[0].decision.rationale == chain
    assert "no, the price is high" not in "".join(m.text for m in seen[1].messages)


def test_cot_menu_thinks_then_chooses_under_constraint() -> None:
    trajectory, seen = play(
        lambda r: r.sampling.choices[0] if r.sampling.choices else "think", {"reasoning": "cot"}, menu=True
    )
    assert [r.tag.purpose for r in seen[:4]] == ["think", "act", "think", "act"]
    assert seen[1].sampling.choices == ("sell now", "wait a step")
    assert all(c.completions[0].credit == "executed" for c in trajectory.calls)


def test_react_grows_one_transcript_with_real_observations() -> None:
    answers = iter([f"Thought: number {i}\nAction: WAIT()" for i in range(5)])
    trajectory, seen = play(lambda r: next(answers), {"reasoning": "react"})
    second = "\n".join(m.text for m in seen[1].messages)
    assert "number 0" in second and "Action: WAIT()" in second and trajectory.transitions[1].input.text in second
    assert "\nObservation:" in seen[0].sampling.stop


def test_react_hallucinated_observations_are_cut() -> None:
    trajectory, _ = play(
        lambda r: "Thought: x\nAction: SELL()\nObservation: you are rich\nAction: WAIT()", {"reasoning": "react"}
    )
    assert [t.action_text for t in trajectory.transitions] == ["SELL()"] * 5


def test_react_thoughts_are_capped_then_the_action_is_asked_for() -> None:
    def thinker(request: Request) -> str:
        return "WAIT()" if "exactly one action call" in request.messages[-1].text else "hmm"

    trajectory, seen = play(thinker, {"reasoning": {"name": "react", "max_iterations": 3}})
    assert len(seen) == 5 * 4  # three thoughts and one forced action per step
    assert [t.action_text for t in trajectory.transitions] == ["WAIT()"] * 5
    assert trajectory.transitions[0].decision.valid


def test_react_snapshot_renders_its_transcript() -> None:
    _, seen = play(lambda r: "Thought: unique-thought\nAction: WAIT()", {"reasoning": "react", "layout": "snapshot"})
    assert "Thought: unique-thought\nAction: WAIT()\nObservation: ok" in seen[1].messages[-1].text
    assert len(seen[4].messages) == 2


def test_the_names_of_the_papers_site_are_understood() -> None:
    from agentspec.registry import REGISTRY

    assert REGISTRY.get("memory", "simple").name == "base"
    assert REGISTRY.get("reasoning", "simple").name == "rule_based"
    assert REGISTRY.get("reasoning", "none").name == "direct"
    for name, parameters in {
        "react": {"max_iterations": 10},
        "self_consistency": {"num_samples": 5, "sampling_temperature": 0.7},
        "mad": {"num_agents": 3, "num_rounds": 2},
        "tot": {"search_strategy": "BFS", "evaluation_strategy": "value", "num_thoughts": 3},
        "rap": {"num_iterations": 10},
        "lats": {"num_iterations": 30, "max_depth": 7, "n_generate_sample": 5},
    }.items():
        assert AgentSpec.from_data({"reasoning": {"name": name, **parameters}}).reasoning.name == name
