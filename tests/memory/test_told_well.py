"""What memories tell is not told twice, keeps its quantities, and is of the time that it says."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest

from agentspec.context import Context
from agentspec.memory.amem import AMem
from agentspec.memory.cam import CamMemory
from agentspec.memory.lightmem import LightMemory
from agentspec.memory.memgpt import MemGPT
from agentspec.memory.mirix import Edit, Mirix
from agentspec.memory.parts.entries import Entry
from agentspec.memory.parts.steps import first_told
from agentspec.services import Time
from tests.memory.bench import Bench, Rows
from tests.memory.by_hand import Asked, learn, recall, seen, services, step

NOTED = {"analyse": '{"keywords": ["k"], "context": "c"}', "evolve": '{"evolve": false}'}


def in_conversation(make: Any, turns: int, **answers: str) -> Any:
    """A memory after four steps of a conversation of which the next prompt holds the newest `turns - 1`."""
    context = Context("conversation", max_turns=turns)
    memory = make(services(Asked(**answers), context=context))
    for i in range(4):
        context.prompt("", f"state {i}")
        context.close((f"GO({i})",))
        learn(memory, step(i, f"state {i}", f"GO({i})"))
    return memory


def notes(memory: Any) -> set[int]:
    """The steps of which notes are recalled; the plain newest steps are left out of the prompt by their kind."""
    items = asyncio.run(memory.retrieve(seen("state"))).items
    return {i for i in range(4) for item in items if item.kind != "step" and f"GO({i})" in item.text}


@pytest.mark.parametrize(("turns", "left"), [(9, set()), (3, {0, 1})])
def test_notes_of_steps_that_the_conversation_holds_are_not_recalled(turns: int, left: set[int]) -> None:
    amem = in_conversation(lambda s: AMem(s, every=1), turns, **NOTED)
    assert first_told(amem.services) == len(left) and notes(amem) == left
    cam = in_conversation(lambda s: CamMemory(s, preset="rl", every=1, theta=1.0), turns)
    assert notes(cam) == left
    for memory in (amem, cam):
        memory.services.clock.episode, memory.services.clock.step, memory.services.clock.before = 1, 0, 4
        assert len(notes(memory)) == 4  # another episode's conversation told them


def test_a_note_with_one_step_that_is_not_held_is_recalled() -> None:
    memory = in_conversation(lambda s: AMem(s, every=3), 3, **NOTED)
    assert first_told(memory.services) == 2 and notes(memory) == {0, 1, 2}


def test_what_a_search_found_is_not_told_beside_the_conversation() -> None:
    search = json.dumps({"calls": [{"function": "recall_search", "query": "state"}]})
    memory = in_conversation(lambda s: MemGPT(s, every=4), 3, edit=search)
    assert len(memory._found) == 4
    assert [text.partition(":")[0] for text in recall(memory, "x")] == ["Step 1", "Step 2"]


def test_a_fact_that_is_updated_in_sleep_is_of_the_time_of_what_changed_it() -> None:
    world = Rows({"Mill open": [1.0, 0.0], "Mill shut": [0.9, 0.43589]})
    script = Asked(sleep='{"action": "update", "text": "Mill open until step 3."}')
    memory = LightMemory(services(script, embedder=world), most_sleep=4, top=5)
    for i, text in ((0, "Mill open"), (2, "Mill shut")):
        memory.entries.put(Entry(i, text, Time(0, i, i), {"topic": 0, "checked": -1}))
    memory.begin_episode(step(0, "x"))  # type: ignore[arg-type]
    assert recall(memory, "mill")[:1] == ["- Mill open until step 3. [step 3]"]


@pytest.mark.parametrize("name", ["cam", "zep"])
def test_of_a_summary_that_was_cut_off_whole_sentences_are_kept(name: str) -> None:
    if name == "cam":
        params = {"name": "cam", "every": 2, "theta": 0.1, "read": "embedding", "summary_tokens": 40}
        bench = Bench(params, {"summarise": "The mill is at 12.5m. The port is at 139.6m."}, scope="run")
    else:
        fact = {"subject": "the mill", "relation": "is at", "object": "the port", "fact": "The mill is at the port."}
        params = {"name": "zep", "every": 2, "answer_tokens": 180}
        said = "The mill is at 12.5m. " + "The port is far, far away from it and from all else. " * 3
        bench = Bench(params, {"extract": {"facts": [fact]}, "community": said}, scope="run")
    for i in range(2):
        bench.step(f"the mill {i}", f"GO({i})")
    bench.end()
    shown = bench.shown("the mill")
    told = "".join(n.text for n in bench.memory.nodes if n.data["level"]) if name == "cam" else shown
    assert "The mill is at 12.5m." in told and "139.6m" not in told and not told.rstrip().endswith("...")


def test_what_is_merged_last_stays_and_no_number_is_cut() -> None:
    memory = Mirix(services(Asked(rewrite="")), entry_tokens=12, core_chars=40, preset="rl", every=1)
    memory._apply("semantic", Edit("insert", fields={"name": "mill", "details": "opens at 8"}))
    for hour in range(9, 30):
        memory._apply("semantic", Edit("merge", 0, {"details": f"seen at hour {hour}"}))
    details = memory.entries[0].fields["details"]
    assert details.endswith("seen at hour 28; seen at hour 29") and details.startswith("seen at hour")
    memory._apply("core", Edit("update", fields={"text": "Deliver order 1234567 to the mill at (139.6m, 24.0m)."}))
    learn(memory, step(0, "a"))
    assert len(memory.core) <= 40 and memory.core == "1234567 to the mill at (139.6m, 24.0m)."
