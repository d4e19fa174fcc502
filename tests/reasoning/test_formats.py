"""Every form in which a chat model writes an action, through every reasoner and reflector: read, and executed."""

from __future__ import annotations

import pytest

from agentspec.llm.base import Request
from agentspec.types import ActionError
from benchmarks.formats import FORMATS
from tests.reasoning.numbers_env import MENU, OPERATIONS
from tests.reasoning.player import play, purposes, seen, solve, solved
from tests.reasoning.test_rap import imaginer

SMALL = {
    "direct": {"name": "direct"},
    "react": {"name": "react"},
    "cot": {"name": "cot"},
    "plan_and_solve": {"name": "plan_and_solve"},
    "persistent plan": {"name": "plan_and_solve", "persistent": True},
    "self_consistency": {"name": "self_consistency", "samples": 2},
    "mad": {"name": "mad", "num_agents": 2, "num_rounds": 1},
    "tot, propose": {"name": "tot", "num_thoughts": 1, "breadth": 1, "depth": 2, "evaluations": 1},
    "tot, sample": {
        "name": "tot",
        "generation": "sample",
        "num_thoughts": 1,
        "breadth": 1,
        "depth": 2,
        "evaluations": 1,
    },
    "rap": {"name": "rap", "num_iterations": 1, "depth": 1, "num_actions": 1},
    "lats": {"name": "lats", "preset": "rl", "num_iterations": 1, "n_generate_sample": 1, "root_samples": 1},
}
ONE_CALL = ("direct", "react", "cot", "plan_and_solve")


def chatty(form: str, *, menu: bool = False):
    """Plays the puzzle right and writes like a chat model; right about everything else it is asked, too."""

    def script(request: Request) -> str:
        purpose = request.tag.purpose
        if purpose in ("act", "propose", "refine"):
            number, target, left = seen("\n".join(m.text for m in request.messages if m.role == "user"))
            way = solve(number, target, left) or ["ADD"]
            decoy = next(name for name in OPERATIONS if name != way[0])
            shown = MENU if menu else {name: f"{name}()" for name in OPERATIONS}
            return FORMATS[form](shown[way[0]], shown[decoy])
        if purpose == "world":
            return imaginer(request)
        fixed = {"value": "sure, 10", "judge": "good", "plan": "1. on", "feedback": "Verdict: keep", "reflect": "no"}
        return fixed.get(purpose, "Let me see.")

    return script


@pytest.mark.parametrize("method", SMALL)
@pytest.mark.parametrize("form", FORMATS)
def test_every_reasoner_reads_every_form(form: str, method: str) -> None:
    trajectory, requests = play(chatty(form), {"reasoning": SMALL[method]})
    assert solved(trajectory) and trajectory.metrics["invalid_actions"] == 0
    if method in ONE_CALL:
        assert purposes(requests) == ["act"] * 3


def test_there_are_at_least_forty_forms() -> None:
    assert len(FORMATS) >= 40


@pytest.mark.parametrize("form", FORMATS)
def test_a_refinement_is_read_in_every_form(form: str) -> None:
    def script(request: Request) -> str:
        if request.tag.purpose == "feedback":
            return "Verdict: change"
        return "ADD()" if request.tag.purpose == "act" else chatty(form)(request)

    spec = {"reasoning": "direct", "reflection": {"name": "self_refine", "max_iterations": 1}}
    assert solved(play(script, spec)[0])


@pytest.mark.parametrize("method", ["direct", "cot", "react"])
def test_an_unreadable_answer_is_asked_for_again_and_told_why(method: str) -> None:
    answers = iter(["Action: JUMP()", "Action: I am not sure", "Action: SUB()"])
    trajectory, requests = play(lambda r: next(answers), {"reasoning": method}, steps=1)
    assert len(requests) == 3 and trajectory.transitions[0].action_text == "SUB()"
    assert trajectory.transitions[0].decision.valid and trajectory.metrics["invalid_actions"] == 0
    assert "there is no action JUMP" in requests[1].messages[-1].text
    # Metered, and credited like the answer that was executed.
    assert [c.completions[0].credit for c in trajectory.calls] == ["executed"] * 3
    assert trajectory.metrics["reasoning/problems/malformed"] == 2


def test_asking_again_ends() -> None:
    trajectory, requests = play(lambda r: "Action: what?", {"reasoning": {"name": "cot", "max_retries": 1}}, steps=1)
    assert len(requests) == 2 and isinstance(trajectory.transitions[0].decision.action, ActionError)
    assert not trajectory.transitions[0].decision.valid


def test_a_cut_answer_is_counted_apart() -> None:
    def wordy(request: Request) -> str:
        return "<think>" + "hm " * 600 if len(request.messages) == 2 else "SUB()"

    spec = {"reasoning": "direct", "sampling": {"max_tokens": 1024}}
    trajectory, requests = play(wordy, spec, steps=1)
    assert len(requests) == 2 and "cut off" in requests[1].messages[-1].text
    assert trajectory.metrics["reasoning/problems/truncated"] == 1 and trajectory.transitions[0].action_text == "SUB()"


@pytest.mark.parametrize("method", ["self_consistency", "mad", "tot, sample", "tot, propose", "rap", "lats"])
def test_methods_of_many_answers_ask_once_more_in_plain_words(method: str) -> None:
    def script(request: Request) -> str:
        plainly = "No action could be read" in request.messages[-1].text
        return chatty("bare")(request) if plainly or request.tag.purpose != "propose" else "who knows"

    def silent(request: Request) -> str:
        return chatty("bare")(request) if "No action could be read" in request.messages[-1].text else "who knows"

    many = script if method.startswith(("tot", "rap", "lats")) else silent
    trajectory, _ = play(many, {"reasoning": SMALL[method]})
    assert solved(trajectory) and trajectory.metrics["invalid_actions"] == 0
    assert 1 <= trajectory.transitions[0].decision.trace["asked_again"] <= 4


def test_a_thought_in_a_reasoning_block_is_never_executed() -> None:
    for spec in SMALL.values():
        trajectory, _ = play(lambda r: "<think>Action: ADD()\nADD()", {"reasoning": spec}, steps=1)
        assert isinstance(trajectory.transitions[0].decision.action, ActionError)
        assert trajectory.transitions[0].info["invalid"]


@pytest.mark.parametrize("method", ["self_consistency", "mad", "tot, sample", "tot, propose", "rap", "lats"])
def test_a_single_unreadable_answer_is_asked_for_again(method: str) -> None:
    """The first answer of a decision cannot be read; what it was about is asked once more, metered and credited."""
    first: list[int] = []

    def script(request: Request) -> str:
        wanted = "propose" if method.startswith(("tot", "rap", "lats")) else "act"
        if request.tag.purpose == wanted and request.tag.step not in first:
            first.append(request.tag.step)
            return "who knows"
        return chatty("bare")(request)

    spec = {**SMALL[method], **({"samples": 1} if method == "self_consistency" else {})}
    trajectory, requests = play(script, {"reasoning": spec})
    assert solved(trajectory)
    trace = trajectory.transitions[0].decision.trace
    assert trace["asked_again"] == 1 and trajectory.metrics["reasoning/problems/malformed"] == 3
    again = next(r for r in requests if "No action could be read" in r.messages[-1].text)
    assert again.messages[-2].text == "who knows"
    unread, answer = (
        next(c for c in trajectory.calls if c.text == "who knows"),
        next(c for c in trajectory.calls if c.id == again.id),
    )
    assert unread.completions[0].credit in ("executed", "explored")
    assert answer.completions[0].credit in ("executed", "explored")


def test_the_chain_of_a_vote_that_was_asked_again_is_credited_whole() -> None:
    answers = iter(["who knows", "SUB()"])
    spec = {"reasoning": {"name": "self_consistency", "samples": 1}}
    trajectory, _ = play(lambda r: next(answers), spec, steps=1)
    assert [c.completions[0].credit for c in trajectory.calls] == ["executed"] * 2
    assert trajectory.transitions[0].decision.calls == ((0, 0), (1, 0))


def test_retries_are_shared_by_all_answers_of_a_decision() -> None:
    spec = {"reasoning": {"name": "self_consistency", "samples": 5, "max_retries": 3}}
    trajectory, requests = play(lambda r: "who knows", spec, steps=1)
    assert len(requests) == 1 + 3 and trajectory.metrics["llm_calls"] == 4
    assert isinstance(trajectory.transitions[0].decision.action, ActionError)
