"""Memories of notes are told once how an episode ended, with what they are asked anyway."""

from __future__ import annotations

from typing import Any

import pytest

from agentspec.memory.parts.telling import outcome
from agentspec.memory.parts.waiting import CONCLUDE
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.memory.bench import Bench, Rows
from tests.memory.one_step import step

ENDED = "The episode ended after 3 steps. Return: +1.00, a success."
FACTS, NOTES = {"facts": []}, {"notes": []}
WRITERS: dict[str, tuple[dict[str, Any], str, Any]] = {
    "mem0": ({"every": 4, "summary_every": 0}, "extract", FACTS),
    "zep": ({"every": 4}, "extract", FACTS),
    "simplemem": ({"window": 4, "gate": 0.0, "overlap": 1}, "compress", NOTES),
    "lightmem": ({"sensory_tokens": 9999, "stm_tokens": 9999}, "extract", FACTS),
}
AT_ONCE: dict[str, dict[str, Any]] = {
    "mem0": {"every": 1, "summary_every": 0},
    "zep": {"every": 1},
    "simplemem": {"window": 1, "gate": 0.0, "overlap": 1},
    "lightmem": {"sensory_tokens": 1, "stm_tokens": 120},
}


def made(name: str, params: dict[str, Any], **spec: Any) -> Bench:
    _, purpose, answer = WRITERS[name]
    return Bench({"name": name, "repairs": 0, **params}, {purpose: answer}, scope="run", **spec)


def three_steps(bench: Bench, *, ended: bool) -> None:
    for i in range(3):
        bench.step(f"town {i}", f"GO({i})", reward=float(i == 2), ended=ended and i == 2)


@pytest.mark.parametrize("name", WRITERS)
def test_the_result_is_told_with_the_steps_that_are_left(name: str) -> None:
    params, purpose, _ = WRITERS[name]
    bench = made(name, params)
    three_steps(bench, ended=True)
    bench.end(success=True)
    assert bench.asked == []
    bench.recall("town")
    assert bench.purposes() == [purpose]
    prompt = bench.prompt(purpose)
    assert prompt.count(ENDED) == 1 and prompt.count(CONCLUDE) == 1 and "GO(2)" in prompt
    assert CONCLUDE not in bench.asked[0].messages[0].text, "the part that all questions share stays the same"
    for i in range(5):
        bench.step(f"village {i}", f"RUN({i})")
    bench.end()
    bench.recall("village")
    assert sum(ENDED in "".join(m.text for m in r.messages) for r in bench.asked) == 1, "once"


@pytest.mark.parametrize("name", WRITERS)
def test_no_call_is_made_for_the_result_alone(name: str) -> None:
    bench = made(name, AT_ONCE[name])
    three_steps(bench, ended=False)
    if name == "lightmem":  # its last topic waits for the topic to change
        bench.memory.sensory, bench.memory.topics = [], []
    asked = len(bench.asked)
    bench.end(success=True)
    again = bench.memory.snapshot()
    bench.memory.restore(again)
    assert bench.memory.snapshot() == again
    shown = bench.shown(f"Episode 1: {ENDED}")
    assert len(bench.asked) == asked
    assert shown.count(f"Episode 1: {ENDED}") == 1, "a note of the episode that it ended, not of the next one"
    assert "episode 1, step 3]" in shown.partition(ENDED)[2]
    for i in range(3):
        bench.step(f"village {i}", f"RUN({i})")
    told = ["".join(m.text for m in r.messages) for r in bench.asked[asked:]]
    assert told and not any(CONCLUDE in text for text in told), "nothing of these steps led to it"


@pytest.mark.parametrize("name", WRITERS)
def test_nothing_waits_where_no_episode_follows(name: str) -> None:
    params, purpose, answer = WRITERS[name]
    bench = Bench({"name": name, **params}, {purpose: answer})
    three_steps(bench, ended=True)
    before = bench.memory.snapshot()
    bench.end(success=True)
    assert ENDED.encode() not in before + bench.memory.snapshot()


@pytest.mark.parametrize("every", [2, 3])
def test_the_last_step_of_a_hierarchy_says_how_it_ended(every: int) -> None:
    params = {"name": "cam", "every": every, "theta": 0.1, "read": "embedding", "recent": 0, "top": 1}
    bench = Bench(params, {"summarise": "All."}, embedder=Rows({"town": [1.0]}), scope="run")
    three_steps(bench, ended=every == 2)
    asked = len(bench.asked)
    bench.end(success=True)
    shown = bench.shown("town")
    last = [node.text for node in bench.memory.nodes if "GO(2)" in node.text]
    assert last == [f"GO(2) -> done (+1.00); {ENDED[:-1]}; seen: town 2"] and shown
    if every == 2:  # the third step was left over, and is summed up with its result
        assert ENDED[:-1] in bench.prompt("summarise")
    else:
        assert len(bench.asked) == asked


def test_without_a_model_the_result_is_a_fact_at_once() -> None:
    bench = Bench({"name": "zep", "extraction": "state", "least": 0.0}, {}, scope="run")
    three_steps(bench, ended=True)
    bench.end(success=True)
    assert f"- Episode 1: {ENDED} [since episode 1, step 3]" in bench.shown("town") and bench.asked == []


def test_an_outcome_is_told_in_the_environments_terms() -> None:
    steps = (step(0, "a", reward=2.5), step(1, "b"))

    def told(env: str, **metrics: Any) -> str:
        return outcome(Trajectory(Task(env, 0), {}, transitions=steps, metrics=metrics))

    earned = {"hourly_profit": 21.414, "net_earnings": 2.5, "deliveries": 1, "ended": "environment"}
    assert told("deliverybench", **earned) == (
        "The episode ended after 2 steps. Return: +2.50, hourly profit ($/h): 21.41, net earnings ($): 2.5, "
        "deliveries: 1."
    )
    assert told("deliverybench", ended="max_steps") == "The episode was cut off after 2 steps. Return: +2.50."
    assert told("minigrid", success=0, efficiency=0.0, ended="budget").endswith(
        "cut off after 2 steps. Return: +2.50, a failure."
    )
    assert told("minigrid", success=1).startswith("The episode ended after 2 steps. Return: +2.50, a success.")


@pytest.mark.parametrize(
    ("params", "answers"),
    [
        ({"name": "memorybank", "every": 3, "writer": "template"}, {}),
        ({"name": "memgpt", "every": 3}, {"edit": {"calls": []}}),
        ({"name": "mirix", "every": 3, "routing": "single"}, {"edit_all": {"edits": []}}),
        ({"name": "openclaw", "every": 3}, {"learn": {"edits": []}, "dream": {"rules": []}}),
    ],
    ids=lambda value: value.get("name", ""),
)
def test_an_episode_cut_off_after_a_whole_period_leaves_its_result(params: dict[str, Any], answers: Any) -> None:
    bench = Bench(params, answers, scope="run")
    three_steps(bench, ended=False)
    written = [p for p in bench.purposes() if p != "dream"]
    bench.end(success=True)
    assert [p for p in bench.purposes() if p != "dream"] == written, "no call for it alone"
    assert ENDED in bench.memory.snapshot().decode()
