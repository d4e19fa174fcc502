"""MemGPT: function calls with their errors, the queue's thresholds, paging, heartbeats."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace

import pytest

from agentspec.context import Context
from agentspec.memory.memgpt import CARRY, FunctionCall, MemGPT
from agentspec.registry import SpecError
from agentspec.tokens import estimate_tokens
from agentspec.types import Recall
from tests.memory.by_hand import TASK, Asked, learn, recall, seen, services, step
from tests.memory.recall_world import succeeds


def calls(*functions: dict, heartbeat: bool = False) -> str:
    return json.dumps({"calls": list(functions), "heartbeat": heartbeat})


def append(text: str, block: str = "task") -> dict:
    return {"function": "core_append", "block": block, "text": text}


NONE = calls()


def gpt(script=None, *, context: Context | None = None, **params) -> MemGPT:
    params = {"queue_tokens": 10_000, **params}
    return MemGPT(services(script or Asked(edit=NONE), context=context), **params)


def test_blocks_are_edited_by_functions_and_always_shown() -> None:
    replace = {"function": "core_replace", "block": "task", "old": "order 3", "new": "order 4"}
    asked = Asked(edit=[calls(append("Open: order 3."), append("Charge at 20 %.", "strategy")), calls(replace)])
    memory = gpt(asked)
    learn(memory, step(0, "a"))
    assert recall(memory, "a")[:2] == ["[task] Open: order 3.", "[strategy] Charge at 20 %."]
    learn(memory, step(1, "b"))
    assert memory.blocks["task"] == "Open: order 4." and asked.purposes == ["edit", "edit"]
    assert "task (14 of 384): Open: order 3." in asked.prompt(1)


def test_a_block_that_is_full_is_an_error_that_goes_back_to_the_model() -> None:
    asked = Asked(edit=[calls(append("x" * 11)), calls(append("short"))])
    memory = gpt(asked, block_chars=10)
    learn(memory, step(0, "a"))
    assert "Error: block task would hold 11 of 10 characters; shorten it" in asked.prompt(1)
    assert memory.blocks["task"] == "short" and memory.metrics()["function_errors"] == 1


@pytest.mark.parametrize(
    ("call", "error"),
    [
        ({"function": "rm"}, "there is no function 'rm'; expected one of core_append"),
        (append("x", "persona"), "there is no block 'persona'; expected one of task, strategy"),
        ({"function": "core_replace", "block": "task", "old": "y"}, "does not contain 'y'"),
        ({"function": "core_replace", "block": "task", "old": ""}, "does not contain ''"),
        ({"function": "archive_insert"}, "archive_insert needs a text"),
    ],
)
def test_wrong_calls_change_nothing(call: dict, error: str) -> None:
    asked = Asked(edit=[calls(call), NONE])
    memory = gpt(asked)
    before = dict(memory.blocks)
    learn(memory, step(0, "a"))
    assert f"Error: {error}" in asked.prompt(1).replace("block task does", "does") and memory.blocks == before
    assert not memory.archive


def test_a_heartbeat_asks_once_more_and_no_more() -> None:
    search = {"function": "recall_search", "query": "key"}
    asked = Asked(edit=calls(search, heartbeat=True))
    memory = gpt(asked)
    learn(memory, step(0, "a key"))
    assert len(asked.requests) == 2 and "recall_search: page 0: Step 1: WAIT() -> done | in: a key" in asked.prompt(1)


def test_searches_come_in_pages_of_five() -> None:
    asked = Asked(edit=NONE)
    memory = gpt(asked, every=100)
    learn(memory, *(step(i, f"red room {i}") for i in range(12)))
    pages = [memory._recall_search(call) for call in (paged(0), paged(1), paged(2), paged(3))]
    # 12 messages match: 5, 5, 2, none.
    assert [p.count("red room") for p in pages] == [5, 5, 2, 0] and pages[3] == "page 3: nothing found"
    for text in ("hot food first", "cold food last", "mind the dog"):
        memory._archive_insert(inserted(text))
    assert memory._archive_search(paged(0, "hot food")).startswith("page 0: hot food first")
    assert "hot food first" in recall(memory, "x")


def paged(page: int, query: str = "red"):
    from agentspec.memory.memgpt import FunctionCall

    return FunctionCall("recall_search", query=query, page=page)


def inserted(text: str):
    from agentspec.memory.memgpt import FunctionCall

    return FunctionCall("archive_insert", text=text)


def test_warning_and_eviction_at_their_thresholds() -> None:
    # A message "Step 1: WAIT() -> done | in: 0aa..." of 32 + 47 = 79 characters is 20 tokens, 21 with its line break.
    asked = Asked(edit=NONE, summary="It went on.")
    memory = gpt(asked, every=100, queue_tokens=112)
    states = [f"{i}{'a' * 46}" for i in range(6)]
    sizes = []
    for i, state in enumerate(states):
        learn(memory, step(i, state))
        sizes.append(memory._size(memory._queue()))
    # 21, 42, 63, 84 = 0.75 of 112 (warning), 105, then 126 > 112: down to 84, which are 4 messages.
    assert sizes == [21, 42, 63, 84, 105, 84]
    assert asked.purposes == ["edit", "summary"]
    assert "Memory pressure: 75% of the queue is used" in asked.prompt(0)
    assert recall(memory, "x")[0] == CARRY.format(summary="It went on.")
    # The warning comes again after an eviction, and the next summary is made of the one before.
    learn(memory, step(6, states[0]), step(7, states[0]))
    assert asked.purposes == ["edit", "summary", "edit", "summary"]
    assert "Summary so far:\nIt went on." in asked.prompt(3) and "Step 3:" in asked.prompt(3)
    # What has left the queue is found by search.
    assert (
        "Step 1:" not in "".join(recall(memory, "x")) and memory._recall_search(paged(0, "aaa wait")).count("Step") == 5
    )


def test_the_last_three_messages_stay() -> None:
    memory = gpt(Asked(edit=NONE, summary="S."), every=100, queue_tokens=10)
    learn(memory, *(step(i, "x") for i in range(5)))
    assert [m.step for m in memory._queue()] == [2, 3, 4] and memory.metrics()["evictions"] == 2


def test_a_conversation_is_evicted_and_its_summary_stands_in_front() -> None:
    context = Context("conversation", count_tokens=len)
    memory = gpt(Asked(edit=NONE, summary="It went on."), context=context, every=100, queue_tokens=500)
    for i in range(6):
        context.prompt("", "x" * 99)
        context.close(("a",))
        learn(memory, step(i, "x"))
    # 6 steps of 100 tokens are above 500: down to 375, 3 steps.
    assert context.steps == 3 and context.carry == CARRY.format(summary="It went on.")
    assert recall(memory, "x") == []


def test_an_eviction_without_a_summary_keeps_the_one_before() -> None:
    memory = gpt(Asked(edit=NONE, summary=["First.", ""]), every=100, queue_tokens=10)
    learn(memory, *(step(i, "x") for i in range(5)))
    assert memory.summary == "First." and memory.services.llm.recorder.problems["memory.m", "malformed"] == 1


@pytest.mark.parametrize("answer", ["", "prose", '{"calls": "x"}', '{"calls": [{"block": "task"}]}'])
def test_a_bad_answer_changes_nothing_and_is_counted(answer: str) -> None:
    memory = gpt(Asked(edit=answer))
    learn(memory, step(0, "a"))
    assert not any(memory.blocks.values()) and memory.services.llm.recorder.problems["memory.m", "malformed"] == 1


def test_snapshots_are_exact_and_stores_are_bounded() -> None:
    insert = {"function": "archive_insert", "text": "fact 0"}
    search = {"function": "archive_search", "query": "fact"}
    asked = Asked(edit=calls(append("a"), insert, search), summary="S.")
    memory = gpt(asked, max_recall=4, max_archive=2, queue_tokens=60)
    learn(memory, *(step(i, f"room {i}") for i in range(7)))
    assert len(memory.recall) == 4 and list(memory.archive.values()) == ["fact 0"], "what is there is not put twice"
    assert memory.blocks["task"] == "a"
    for fact in ("fact 1", "fact 2"):
        memory._archive_insert(inserted(fact))
    assert list(memory.archive.values()) == ["fact 1", "fact 2"]
    other = gpt(max_recall=4, max_archive=2, queue_tokens=60)
    other.services.clock.step = memory.services.clock.step
    other.restore(memory.snapshot())
    assert other.snapshot() == memory.snapshot() and recall(other, "x") == recall(memory, "x")
    assert "Core memory\n[task] a" in memory.describe()


def test_a_task_of_an_earlier_episode_is_marked_until_it_is_written_anew() -> None:
    memory = gpt(
        Asked(edit=[calls(append("Order 3."), append("Charge.", "strategy")), NONE, calls(append("Order 4."))])
    )
    learn(memory, step(0, "a"))
    memory.begin_episode(TASK)
    learn(memory, step(0, "b"))
    assert recall(memory, "b")[:2] == ["[task, as of an earlier episode] Order 3.", "[strategy] Charge."]
    learn(memory, step(1, "c"))
    assert recall(memory, "c")[0] == "[task] Order 3.\nOrder 4."


def test_bad_parameters_are_refused() -> None:
    for bad in ({"every": 0}, {"max_recall": 3}, {"preset": "x"}):
        with pytest.raises(SpecError, match="memgpt"):
            gpt(**bad)


@pytest.mark.parametrize("layout", ["snapshot", "conversation"])
@pytest.mark.parametrize("scope", ["episode", "run"])
def test_a_fact_seen_long_ago_decides(scope: str, layout: str) -> None:
    assert not succeeds({"name": "base", "window": 5}, scope=scope, layout=layout)
    for preset in ("paper", "rl"):
        assert succeeds({"name": "memgpt", "preset": preset}, scope=scope, layout=layout)


@pytest.mark.parametrize(("recall_tokens", "layout", "room"), [(512, "snapshot", 384), (512, "conversation", 768)])
def test_what_stands_in_the_blocks_is_always_shown_whole(recall_tokens: int, layout: str, room: int) -> None:
    """Both blocks as full as they may be, beside a full queue."""
    context = Context(layout, recall_tokens=recall_tokens, count_tokens=estimate_tokens)
    memory = MemGPT(services(Asked(edit=NONE), context=context), every=99)
    assert memory.room == room and MemGPT(services(context=Context("snapshot", recall_tokens=1800))).room == 1350
    learn(memory, *(step(i, f"{i} " + "b" * 120) for i in range(4)))
    for name in ("task", "strategy"):
        assert memory._call(FunctionCall("core_append", name, "x y " * (room // 4))) == "core_append: done"
        assert "Error" in memory._call(FunctionCall("core_append", name, "more"))
    recall = asyncio.run(memory.retrieve(seen("now")))
    shown = Recall(tuple(i for i in recall.items if layout == "snapshot" or i.kind != "step"))
    text = shown.render(recall_tokens, estimate_tokens)
    assert all(f"[{name}] {memory.blocks[name]}" in text for name in ("task", "strategy"))


def test_what_a_search_found_stays_until_the_next_search_and_once() -> None:
    asked = Asked(edit=[calls({"function": "recall_search", "query": "mill"}), NONE, NONE])
    memory = gpt(asked)
    learn(memory, step(0, "a mill"))
    memory.recall[77] = replace(next(iter(memory.recall.values())), step=9)
    memory._words.put(77, memory.recall[77].text)
    learn(memory, step(1, "b"))
    assert memory._found == ["Step 1: WAIT() -> done | in: a mill"]
    assert memory._recall_search(FunctionCall("recall_search", query="mill")).count("a mill") == 1
