"""Design invariant 9: what an agent shows a model is what it acts on, however long everything else is.

Every prompt of a step contains the current observation, every action under judgement, and what memory was asked for.
"""

from __future__ import annotations

import re
from typing import Any

import gymnasium
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.reasoning.numbers_env import MENU, OPERATIONS, NumbersEnv

LONG = "agentspec-test/NumbersLong-v0"
NAMES = "|".join(OPERATIONS)


class LongNumbers(NumbersEnv):
    """The puzzle in a place with much to say."""

    def __init__(self, words: int = 0, **options: Any) -> None:
        super().__init__(**options)
        self.words = words

    def _observation(self) -> dict[str, Any]:
        text = super()._observation()["text"]
        return {"text": f"Begin {self.left}. " + "much to see " * self.words + text + f" End {self.left}."}


if LONG not in gymnasium.registry:
    gymnasium.register(LONG, entry_point=LongNumbers)

METHODS: dict[str, dict[str, Any]] = {
    "direct": {},
    "cot": {},
    "react": {},
    "plan_and_solve": {},
    "persistent": {"name": "plan_and_solve", "persistent": True},
    "self_consistency": {},
    "mad": {"num_agents": 2, "num_rounds": 2},
    "tot": {"preset": "rl", "depth": 3},
    "tot, vote": {"name": "tot", "preset": "rl", "evaluation_strategy": "vote"},
    "rap": {"preset": "rl", "depth": 3},
    "lats": {"preset": "rl"},
    "lats, imagined": {"name": "lats", "preset": "rl", "world": "model"},
}


def run(method: str, words: int, chatter: int, layout: str, menu: bool) -> tuple[Trajectory, list[Request]]:
    """An episode in which everybody is wordy."""
    requests: list[Request] = []
    talk = "on the one hand and the other " * chatter

    def script(request: Request) -> Any:
        requests.append(request)
        purpose, n = request.tag.purpose, request.sampling.n
        if request.sampling.choices:
            return [request.sampling.choices[(request.seed + i) % len(request.sampling.choices)] for i in range(n)]
        names = [f"{list(OPERATIONS)[(request.seed + i) % 3]}()" for i in range(n)]
        if purpose == "feedback":
            return f"Verdict: change\n{talk}"
        if purpose in ("value", "vote", "judge"):
            return f"{talk} likely, 1, 5 good"
        if purpose == "world":
            return f"{talk}\nEarned: 0\nGoal: no"
        if purpose == "propose" and n == 1:
            return "\n".join(f"{name}()" for name in OPERATIONS)
        return [f"Thought: {talk}\nAction: {name}" for name in names]

    name = method.partition(",")[0]
    spec = {
        "reasoning": {"name": name, **METHODS.get(method, {})},
        "memory": {"name": "base", "window": 2},
        "layout": layout,
        "sampling": {"max_tokens": 100_000},
        "recall_tokens": 100_000,
    }
    if method == "self_refine":
        spec |= {"reasoning": "react", "reflection": "self_refine"}
    task = Task(LONG, 0, {"words": words, "steps": 3, "target": 1000, "menu": menu})
    (trajectory,) = Runner(AgentSpec.from_data(spec), ScriptedLLM(script)).run([Job(task)])
    assert trajectory.status == "completed", trajectory.error
    return trajectory, requests


def judged(request: Request) -> list[str]:
    """What is under judgement according to the request's wording: one entry for each action that must be there."""
    text = request.messages[-1].text
    steps = re.findall(r"^(\d+)\. (.*)$", text.split("End", 1)[-1], re.MULTILINE)
    if request.tag.purpose == "feedback":
        return re.findall(r"Attempt \d+: (.+)", text)
    if request.tag.purpose == "judge":
        return re.findall(r"would be: (.+)", text)
    return [action for _, action in steps]


@pytest.mark.parametrize("menu", [False, True], ids=["free", "menu"])
@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("method", [*METHODS, "self_refine"])
@settings(max_examples=4, deadline=None)
@given(words=st.integers(0, 400), chatter=st.integers(0, 40))
def test_prompts_hold_what_is_acted_on(method: str, layout: str, menu: bool, words: int, chatter: int) -> None:
    trajectory, requests = run(method, words, chatter, layout, menu)
    shown = {t.step: t.input.text for t in trajectory.transitions}
    written = set(MENU.values()) | {f"{name}()" for name in OPERATIONS}
    for request in requests:
        whole = "\n".join(m.text for m in request.messages)
        assert shown[request.tag.step] in whole  # the observation, from beginning to end
        for step in range(max(0, request.tag.step - 2), request.tag.step):
            assert trajectory.transitions[step].action_text in whole  # what memory was asked for
        if request.tag.purpose in ("value", "vote", "judge", "feedback", "world"):
            actions = judged(request)
            assert actions
            for action in actions:
                assert any(name in action for name in written) or (menu and action.strip()), (action, request.tag)
            numbers = [int(n) for n in re.findall(r"^(\d+)\. ", request.messages[-1].text.split("End", 1)[-1], re.M)]
            assert numbers == list(range(1, len(numbers) + 1))  # none of the steps is cut away
    if method == "mad" and not menu:
        for request in requests:
            quotes = re.findall(r"^Adviser \d: ((?:.|\n)*?)(?=\nAdviser|\n\nCheck)", request.messages[-1].text, re.M)
            assert all(re.search(rf"Action: (?:{NAMES})\(\)$", quoted) for quoted in quotes)
