"""MemoryBank: the forgetting curve in numbers, three granularities in one recall, writing that survives bad answers."""

from __future__ import annotations

import asyncio
import json
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.memory.memorybank import MemoryBank
from agentspec.memory.memorybank.entries import Entry, avoid_by_rule, by_rule, retention
from agentspec.registry import SpecError
from tests.memory.by_hand import TASK, Asked, episode, learn, recall, services, step
from tests.memory.recall_world import succeeds

CONCLUDED = '{"insights": ["WAIT costs 1 % of energy."], "avoid": ["TAKE with full hands"], "next": ["GO", "TAKE"]}'


def bank(script=None, **params) -> MemoryBank:
    return MemoryBank(services(script), **params)


def test_retention_in_numbers() -> None:
    # e^0, e^-1, e^-5/5, e^-10/2; the published code's e^(-t*S/5) would give e^-5 and e^-4 for the last two.
    values = [retention(0, 1), retention(1, 1), retention(5, 5), retention(10, 2)]
    assert values == pytest.approx([1.0, 0.36788, 0.36788, 0.0067379], abs=1e-5)
    assert retention(100, 1, unit=100) == pytest.approx(0.36788, abs=1e-5)


@given(st.floats(0.1, 50), st.integers(1, 50), st.floats(0.1, 20))
def test_retention_rises_with_strength_and_falls_with_time(t: float, s: int, unit: float) -> None:
    assert retention(t, s, unit) <= retention(t, s + 1, unit) <= 1
    assert retention(t + 1, s, unit) <= retention(t, s, unit)


def test_recall_adds_to_strength_and_starts_time_anew() -> None:
    memory = bank(forget="never", recent=0)
    learn(memory, step(0, "a red key on the table"), step(1, "rain"))
    memory.services.clock.step = 9
    assert recall(memory, "where is the red key?", 1) == ["Step 1: WAIT() -> done | in: a red key on the table"]
    recalled, other = memory.entries.values()
    assert (recalled.strength, recalled.since, other.strength, other.since) == (2, 9, 1, 2)
    # Born at step 1 of the run, recalled at 9: at step 19 R is e^(-10/(100*2)), of the other e^(-17/100).
    memory.services.clock.step = 19
    assert [memory._retained(k) for k in memory.entries] == pytest.approx([0.95123, 0.84366], abs=1e-5)


def test_the_threshold_keeps_what_it_says() -> None:
    memory = bank(forget="threshold", least=0.5, time_unit=10)
    now = 20
    memory.services.clock.step = now
    # R >= 0.5 while t <= 10 * S * ln 2 = 6.93 S: of S = 1 ages 6 and 7, of S = 2 ages 13 and 14.
    ages = [(6, 1), (7, 1), (13, 2), (14, 2)]
    memory.entries = {i: Entry("raw", f"{i}", 0, i, now - t, s) for i, (t, s) in enumerate(ages)}
    memory._fade()
    assert list(memory.entries) == [0, 2] and memory.metrics()["forgotten"] == 2


@pytest.mark.parametrize("passes", [1, 4])
def test_what_is_left_is_the_retention_however_often_it_is_drawn(passes: int) -> None:
    memory = bank(forget="sample", time_unit=20, max_entries=5000)
    memory.services.rng = random.Random(7)
    memory.entries = {i: Entry("raw", "x", 0, i, 0) for i in range(4000)}
    for i in range(passes):
        memory.services.clock.step = 20 * (i + 1) // passes
        memory._fade()
    # t = 20, S = 1: R = e^-1 = .3679; of 4000 draws the standard deviation is sqrt(R (1 - R) / 4000) = .0076.
    assert len(memory.entries) / 4000 == pytest.approx(0.3679, abs=4 * 0.0076)


def test_a_day_is_summarised_and_mixed_at_recall() -> None:
    asked = Asked(summary="Went and took a box.", insight=CONCLUDED, overview="All is well.")
    memory = bank(asked, every=3, overview_every=1, forget="never", recent=1)
    learn(memory, *(step(i, f"room {i}", f"GO({i})", reward=float(i == 1)) for i in range(3)))
    assert asked.purposes == ["summary", "insight", "overview"]
    shared = "Step 2: GO(1) -> done (+1.00) | in: room 1"
    assert shared in asked.prompt(0) and shared in asked.prompt(1)
    assert "- Went and took a box." in asked.prompt(2) and "- Avoid: TAKE with full hands" in asked.prompt(2)
    assert recall(memory, "room 0") == [
        "[Overview] All is well.",
        "[Environment Insight] WAIT costs 1 % of energy.",
        "[Environment Insight] Avoid: TAKE with full hands",
        "[Trajectory Summary] Went and took a box.",
        "Step 1: GO(0) -> done | in: room 0",
        "Step 2: GO(1) -> done (+1.00) | in: room 1",
        "[Plan after step 3] GO; TAKE",
        "Step 3: GO(2) -> done | in: room 2",
    ]


def test_each_kind_has_its_quota() -> None:
    memory = bank(insights=1, summaries=2, raw=1, recent=0, forget="never")
    for i in range(4):
        for kind in ("raw", "summary", "insight"):
            memory._add(kind, f"{kind} number {i}", i)
    memory.services.clock.step = 9
    kinds = [item.kind for item in asyncio.run(memory.retrieve(step(9, "number 2").input)).items]
    assert kinds == ["insight", "summary", "summary", "episodic"]


def test_a_known_insight_grows_stronger_and_is_not_doubled() -> None:
    asked = Asked(summary="Nothing new.", insight=CONCLUDED)
    memory = bank(asked, every=1, overview_every=0, forget="never")
    learn(memory, step(0, "a"), step(1, "b"))
    found = [(e.text, e.strength) for e in memory.entries.values() if e.kind == "insight"]
    assert found == [("WAIT costs 1 % of energy.", 2), ("Avoid: TAKE with full hands", 2)]
    # The second day's question shows what is known.
    assert "Insights so far:\n(none)" in asked.prompt(1) and "- WAIT costs 1 % of energy." in asked.prompt(3)


@pytest.mark.parametrize("answer", ["", "no JSON here", '{"insights": "one"}', '{"insights": [1]}'])
def test_a_bad_answer_writes_nothing_and_is_counted(answer: str) -> None:
    memory = bank(Asked(summary="", insight=answer), every=2, overview_every=0, forget="never")
    learn(memory, step(0, "a"), step(1, "b"))
    assert {e.kind for e in memory.entries.values()} == {"raw"} and memory._days == 1
    assert memory.services.llm.recorder.problems["memory.m", "malformed"] == 2


def test_a_summary_that_was_cut_off_keeps_its_whole_sentences() -> None:
    from agentspec.memory.parts.steps import written
    from agentspec.services import Answer

    cut = Answer("The box is at 5m. It was taken. The next", problem="truncated")
    assert written(cut, 50, len) == "The box is at 5m. It was taken."
    assert written(Answer("The next", problem="truncated"), 50, len) == ""


def test_rules_write_without_a_model() -> None:
    asked = Asked()
    memory = bank(asked, writer="template", every=3, forget="never")
    learn(memory, step(0, "a", "GO(1)"), step(1, "b", "TAKE(2)", error="hands full"), step(2, "c", "GO(3)"))
    texts = {e.kind: e.text for e in memory.entries.values()}
    assert texts["summary"] == "Steps 1-3: GO x2, TAKE x1; 1 failed; last: GO(3) -> done."
    assert texts["insight"] == "Avoid: TAKE(2) failed: hands full" and not asked.requests
    assert by_rule([], "Over.") == "Over." and avoid_by_rule([]) == []


def test_what_is_retained_least_goes_first() -> None:
    memory = bank(max_entries=3, forget="never", recent=0)
    learn(memory, step(0, "zero"), step(1, "one"), step(2, "two"))
    recall(memory, "zero", 1)
    learn(memory, step(3, "three"))
    # Step 1 was recalled at 3 and has S = 2; step 2 is the oldest of the others.
    assert [e.step for e in memory.entries.values()] == [0, 2, 3]


def test_the_episode_end_is_written_only_for_a_later_one() -> None:
    asked = Asked(summary="Done.", insight=CONCLUDED)
    for carried, calls in ((True, 2), (False, 0)):
        asked.requests.clear()
        memory = bank(asked, every=5)
        memory.services.carried = carried
        steps = [step(0, "a"), step(1, "b", reward=1.0, ended=True)]
        learn(memory, *steps)
        asyncio.run(memory.end_episode(episode(*steps, success=True)))
        assert len(asked.requests) == calls
        if carried:  # 2 steps, 0 + 1 reward; what to do next is now a matter of the next episode
            assert "The episode ended after 2 steps. Return: +1.00, a success." in asked.prompt()
            memory.begin_episode(TASK)
            assert "[Plan for the next episode] GO; TAKE" in recall(memory, "a")
    asyncio.run(bank(asked).end_episode(episode()))


def test_nothing_is_shown_twice() -> None:
    memory = bank(recent=2, raw=5, forget="never")
    learn(memory, *(step(i, f"room {i}") for i in range(4)))
    shown = recall(memory, "room 3")
    assert len(shown) == len(set(shown)) == 4


def test_snapshots_are_texts_and_exact() -> None:
    memory = bank(Asked(summary="Went.", insight=CONCLUDED, overview="Well."), every=2, overview_every=2)
    learn(memory, *(step(i, f"room {i}") for i in range(5)))
    blob = memory.snapshot()
    other = bank(every=2)
    other.services.clock.step = memory.services.clock.step
    other.restore(blob)
    assert other.snapshot() == blob and recall(other, "room 1") == recall(memory, "room 1")
    assert not [v for v in json.loads(blob)[0] if not isinstance(v[1][1], str)]


def test_bad_parameters_are_refused() -> None:
    for bad in ({"writer": "x"}, {"forget": "x"}, {"every": 0}, {"time_unit": 0.0}, {"preset": "x"}):
        with pytest.raises(SpecError, match="memorybank"):
            bank(**bad)


@pytest.mark.parametrize("layout", ["snapshot", "conversation"])
@pytest.mark.parametrize("scope", ["episode", "run"])
def test_a_fact_seen_long_ago_decides(scope: str, layout: str) -> None:
    assert not succeeds({"name": "base", "window": 5}, scope=scope, layout=layout)
    assert succeeds({"name": "memorybank", "forget": "threshold"}, scope=scope, layout=layout)
    assert succeeds({"name": "memorybank", "preset": "rl"}, scope=scope, layout=layout)


def test_a_summary_of_an_earlier_episode_says_that_it_is_over() -> None:
    asked = Asked(summary="Order 3 is in the bag.", insight=CONCLUDED)
    memory = bank(asked, every=1, raw=0, recent=0, insights=0)
    learn(memory, step(0, "a mill"))
    assert recall(memory, "order 3")[0] == "[Trajectory Summary] Order 3 is in the bag."
    memory.services.clock.episode = 1
    memory.begin_episode(TASK)
    assert recall(memory, "order 3")[0] == "[Trajectory Summary] (Episode 1, over) Order 3 is in the bag."
