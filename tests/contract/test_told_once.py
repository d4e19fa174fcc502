"""Memories tell the newest steps where nothing else does, and not where the prompt tells them anyway."""

from __future__ import annotations

from typing import Any

import pytest

from agentspec.llm.base import Request
from agentspec.types import Task
from tests.contract.harness import Case, affordable, example, start, steps
from tests.reasoning.numbers_env import NUMBERS

RAW = ("generative",)
"""Recalls steps as they were, by similarity, in a snapshot also those that a transcript tells."""
ALL = [c for c in affordable(("memory",)) if c.label == "rl"]
CASES = [c for c in ALL if c.name not in RAW]
TASK = Task(NUMBERS, 0, {"menu": False, "steps": 12, "target": 1000})


def prompts(case: Case, number: int, **spec: Any) -> list[str]:
    """The actor's prompts of the first steps; the number is 3 and grows by 3."""
    answer = example(case)

    def script(request: Request) -> Any:
        return "Action: ADD()" if request.tag.module.startswith("reasoning.") else answer(request)

    played = start(case, script, **spec)
    for step in steps(played, TASK):
        if step.step + 1 == number:
            break
    asked = [r for r in played.requests if r.tag.module.startswith("reasoning.")]
    return ["\n".join(m.text for m in request.messages) for request in asked]


@pytest.mark.parametrize("reasoning", ["react", {"name": "react", "history": 1}])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_newest_step_is_told_once_beside_a_transcript(case: Case, reasoning: Any) -> None:
    assert [p.count("the number is now 9") for p in prompts(case, 3, layout="snapshot", reasoning=reasoning)][2] == 1


@pytest.mark.parametrize("case", ALL, ids=str)
def test_a_conversation_is_not_told_again(case: Case) -> None:
    assert [p.count("the number is now 9") for p in prompts(case, 3)][2] <= 1


WAITING = [c for c in CASES if c.name in ("amem", "cam", "langmem", "lightmem", "mem0", "mirix", "simplemem", "zep")]


@pytest.mark.parametrize("layout", ["snapshot", "conversation"])
@pytest.mark.parametrize("case", WAITING, ids=str)
def test_a_step_that_no_note_knows_yet_stays_in_sight(case: Case, layout: str) -> None:
    """Four steps after it, where the conversation has let it go."""
    shown = prompts(case, 6, layout=layout, max_turns=2)[5]
    assert "ADD() -> the number is now 6" in shown
