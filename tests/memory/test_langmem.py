"""LangMem, native: edits of facts by id, experiences, instructions that only the optimiser changes."""

from __future__ import annotations

import asyncio
import json

import pytest

from agentspec.memory.langmem import Edit, LangMem
from agentspec.registry import SpecError
from tests.memory.by_hand import Asked, episode, learn, recall, services, step
from tests.memory.recall_world import succeeds

EPISODE = '{"observation": "Low battery.", "thoughts": "Charge.", "action": "GO(1)", "result": "Full after 5 min."}'


def facts(*edits: dict) -> str:
    return json.dumps({"edits": list(edits)})


def langmem(script=None, **params) -> LangMem:
    return LangMem(services(script), **{"recent": 0, **params})


def test_facts_are_inserted_patched_and_deleted_by_id() -> None:
    memory = langmem()
    for text in ("The mill is closed.", "The quay is wet.", "The dog bites."):
        memory._apply(Edit("insert", text=text))
    memory._apply(Edit("patch", 0, "The mill is\nopen."))
    memory._apply(Edit("delete", 1))
    assert memory.facts == {2: "The dog bites.", 0: "The mill is open."}
    assert recall(memory, "mill", 1) == ["- The mill is open."]
    for wrong in (Edit("patch", 9, "x"), Edit("delete", 9), Edit("insert"), Edit("patch", 0), Edit("patch", None, "x")):
        memory._apply(wrong)
    memory._apply(Edit("insert", text="The dog bites."))
    assert memory.facts == {2: "The dog bites.", 0: "The mill is open."} and memory.metrics()["refused_edits"] == 6


def test_the_manager_sees_the_nearest_facts_with_their_ids() -> None:
    asked = Asked(semantic=[facts({"op": "insert", "text": "The mill is open."}), facts({"op": "delete", "id": 0})])
    memory = langmem(asked, types=["semantic"], query_limit=1)
    learn(memory, step(0, "the mill"))
    assert "(none)" in asked.prompt(0) and memory.facts == {0: "The mill is open."}
    learn(memory, step(1, "the mill again"))
    assert "0: The mill is open." in asked.prompt(1) and not memory.facts
    assert "Step 2:" in asked.prompt(1) and "Step 1:" not in asked.prompt(1)


def test_the_types_are_written_at_their_own_pace() -> None:
    asked = Asked(semantic=facts(), episodic=EPISODE, procedural="Charge at 20 %.")
    memory = langmem(asked, every=2, episode_every=4)
    learn(memory, *(step(i, f"room {i}") for i in range(4)))
    assert asked.purposes == ["semantic", "semantic", "episodic", "procedural"]
    assert all(f"Step {i}:" in asked.prompt(2) for i in (1, 2, 3, 4))
    assert recall(memory, "battery") == [
        "Instructions of your own: Charge at 20 %.",
        "A past experience: Low battery. | Charge. | GO(1) -> Full after 5 min.",
    ]


def test_instructions_change_only_by_the_optimisers_answer() -> None:
    asked = Asked(procedural=["Charge at 20 %.", "NO_CHANGE", "", "Charge at 30 %."])
    memory = langmem(asked, types=["procedural"], episode_every=1)
    seen = []
    for i in range(4):
        learn(memory, step(i, "a"))
        seen.append(memory.instructions)
    assert seen == ["Charge at 20 %."] * 3 + ["Charge at 30 %."]
    assert "of its own:\nCharge at 20 %." in asked.prompt(1)


def test_the_end_is_written_only_for_a_later_episode() -> None:
    for carried, purposes in ((True, ["semantic", "episodic", "procedural"]), (False, [])):
        asked = Asked(semantic=facts(), episodic=EPISODE, procedural="Go.")
        memory = langmem(asked, every=9, episode_every=0)
        memory.services.carried = carried
        learn(memory, step(0, "a", reward=1.0))
        asyncio.run(memory.end_episode(episode(step(0, "a", reward=1.0))))
        assert asked.purposes == purposes
        assert not carried or "ended after 1 steps. Return: +1.00." in asked.prompt()


@pytest.mark.parametrize("answer", ["", "prose {", '{"edits": 3}', '{"observation": 1}'])
def test_a_bad_answer_changes_nothing_and_is_counted(answer: str) -> None:
    memory = langmem(Asked(semantic=answer, episodic=answer), types=["semantic", "episodic"], episode_every=1)
    learn(memory, step(0, "a"))
    assert not memory.facts and not memory.episodes
    assert memory.services.llm.recorder.problems["memory.m", "malformed"] == 2


def test_snapshots_are_exact_and_stores_are_bounded() -> None:
    memory = langmem(
        Asked(semantic=facts(), episodic=EPISODE, procedural="Go."), max_facts=2, max_episodes=1, episode_every=2
    )
    for i in range(3):
        memory._apply(Edit("insert", text=f"fact {i}"))
    learn(memory, *(step(i, "a") for i in range(5)))
    assert list(memory.facts.values()) == ["fact 1", "fact 2"] and len(memory.episodes) == 1
    other = langmem(max_facts=2, max_episodes=1)
    other.restore(memory.snapshot())
    assert other.snapshot() == memory.snapshot() and recall(other, "fact") == recall(memory, "fact")
    assert "Facts\n1: fact 1" in memory.describe()


def test_bad_parameters_are_refused() -> None:
    for bad in ({"types": ["x"]}, {"types": []}, {"every": 0}, {"preset": "x"}):
        with pytest.raises(SpecError, match="langmem"):
            langmem(**bad)


@pytest.mark.parametrize("layout", ["snapshot", "conversation"])
@pytest.mark.parametrize("scope", ["episode", "run"])
def test_a_fact_seen_long_ago_decides(scope: str, layout: str) -> None:
    assert not succeeds({"name": "base", "window": 5}, scope=scope, layout=layout)
    for preset in ("paper", "rl"):
        assert succeeds({"name": "langmem", "preset": preset}, scope=scope, layout=layout)


def test_a_fact_of_an_earlier_episode_says_so() -> None:
    asked = Asked(semantic=[facts({"op": "insert", "text": "Order 3 is in the bag."}), facts()])
    memory = langmem(asked, types=["semantic"])
    learn(memory, step(0, "the mill"))
    assert recall(memory, "order") == ["- Order 3 is in the bag."]
    again = langmem(asked, types=["semantic"])
    again.restore(memory.snapshot())
    again.services.clock.episode = 1
    assert recall(again, "order") == ["- Order 3 is in the bag. [episode 1]"]
    learn(again, step(0, "the mill"))
    assert "0: Order 3 is in the bag. [episode 1]" in asked.prompt()
    again._apply(Edit("patch", 0, "Order 3 is delivered."))
    assert recall(again, "order") == ["- Order 3 is delivered."]
