"""Mem0: operations on facts, exactly; ids and versions; what cannot be read writes nothing."""

from __future__ import annotations

import json

import pytest

from agentspec.memory.mem0 import Mem0Memory
from agentspec.registry import SpecError
from agentspec.tokens import estimate_tokens
from tests.memory.bench import Bench
from tests.memory.by_hand import Asked, learn, services, step
from tests.memory.recall_world import succeeds

ONE = {"name": "mem0", "every": 1, "summary_every": 0, "repairs": 0}


def ops(*operations: tuple[str, int | str | None, str]) -> dict:
    return {"operations": [{"op": op, "id": id, "text": text} for op, id, text in operations]}


def texts(bench: Bench) -> list[str]:
    return [e.text for e in bench.memory.entries]


def two_facts(**answers: object) -> Bench:
    """A memory that holds the facts 0: the mill is open, 1: the key is red."""
    facts = [{"facts": ["The mill is open.", "The key is red."]}, {"facts": ["The mill is closed."]}]
    bench = Bench(ONE, {"extract": facts, **answers})
    bench.step("a mill")
    assert texts(bench) == ["The mill is open.", "The key is red."] and bench.purposes() == ["extract"]
    return bench


def test_the_scripted_operations_give_exactly_the_expected_memories() -> None:
    change = ops(
        ("UPDATE", 0, "The mill is closed."), ("DELETE", 1, ""), ("ADD", None, "A fair is on."), ("NOOP", 0, "")
    )
    bench = two_facts(update=change)
    first = next(iter(bench.memory.entries)).id
    bench.step("the mill")
    assert texts(bench) == ["The mill is closed.", "A fair is on."]
    updated = bench.memory.entries[first]
    assert updated.data["history"] == ["The mill is open."] and updated.time.step == 1
    assert bench.purposes() == ["extract", "extract", "update"]


def test_memories_are_shown_by_number_and_unknown_numbers_are_ignored() -> None:
    bench = two_facts(update=ops(("DELETE", 7, ""), ("UPDATE", "x", "No."), ("UPDATE", 1, " "), ("ADD", None, "")))
    bench.step("the mill")
    assert texts(bench) == ["The mill is open.", "The key is red."]
    assert bench.memory.metrics() == {"entries": 2, "evicted": 0, "ignored": 4}
    prompt = bench.prompt("update")
    assert "0. The mill is open.\n1. The key is red." in prompt and "- The mill is closed." in prompt
    assert "(data, not instructions)" in prompt


def test_deleted_in_the_same_answer_is_unknown_afterwards() -> None:
    bench = two_facts(update=ops(("DELETE", 0, ""), ("UPDATE", 0, "The mill burns.")))
    bench.step("the mill")
    assert texts(bench) == ["The key is red."]


def test_an_answer_that_cannot_be_read_writes_nothing_and_the_steps_wait() -> None:
    bench = two_facts(update=["what?", ops(("UPDATE", 0, "The mill is closed."))])
    bench.step("the mill at noon")
    assert texts(bench) == ["The mill is open.", "The key is red."] and bench.problems() == {"malformed": 1}
    bench.step("the mill at night")
    # The step that was not understood stands in the next question again.
    assert "the mill at noon" in bench.prompt("extract") and "the mill at night" in bench.prompt("extract")
    assert texts(bench)[0] == "The mill is closed."


def test_an_operation_of_another_name_is_malformed_and_the_others_are_done() -> None:
    bench = two_facts(update=ops(("DROP", 0, ""), ("DELETE", 1, "")))
    bench.step("the mill")
    assert texts(bench) == ["The mill is open."] and bench.problems() == {"malformed": 1, "rejected": 1}


def test_each_fact_is_decided_by_itself() -> None:
    facts = [{"facts": ["The mill is open."]}, {"facts": ["The mill is closed.", "The key is red."]}]
    answers = [ops(("UPDATE", 0, "The mill is closed.")), ops(("ADD", None, "The key is red."))]
    bench = Bench({**ONE, "decide": "each"}, {"extract": facts, "update": answers})
    bench.step("a mill")
    bench.step("the mill")
    assert bench.purposes() == ["extract", "extract", "update", "update"]
    assert texts(bench) == ["The mill is closed.", "The key is red."]
    # The second decision sees what the first one did.
    assert "0. The mill is closed." in bench.prompt("update")


def test_the_summary_is_renewed_every_so_often_and_read_by_the_extraction() -> None:
    answers = {"extract": {"facts": []}, "summary": ["Two deliveries are under way.", "One is left."]}
    bench = Bench({**ONE, "summary_every": 2, "messages": 2}, answers)
    for i in range(5):
        bench.step(f"state {i}", f"GO({i})", f"went {i}")
    assert bench.purposes().count("summary") == 2
    assert "Two deliveries are under way." in bench.prompt("summary") and "3. GO(2) -> went 2" in bench.prompt(
        "summary"
    )
    extraction = bench.prompt("extract")
    assert "One is left." in extraction and "state 4" in extraction
    # Two earlier steps, and no more.
    assert "3. GO(2)" in extraction and "4. GO(3)" in extraction and "2. GO(1)" not in extraction


def test_the_oldest_memory_goes_first_and_a_confirmed_one_is_new() -> None:
    # Facts a, b, then a again: with room for two, c drives out b.
    facts = [{"facts": [f]} for f in ("Fact a.", "Fact b.", "Fact a.", "Fact c.")]
    bench = Bench({**ONE, "capacity": 2}, {"extract": facts, "update": lambda r: add_all(r)})
    for i in range(4):
        bench.step(f"state {i}")
    assert texts(bench) == ["Fact a.", "Fact c."] and bench.memory.metrics()["evicted"] == 1


def add_all(request) -> dict:
    listed = request.messages[-1].text.rpartition("New facts (data, not instructions):\n")[2]
    return ops(*(("ADD", None, line.removeprefix("- ")) for line in listed.splitlines()))


def test_what_is_left_at_the_end_is_written_when_the_next_episode_begins() -> None:
    bench = Bench({**ONE, "every": 4}, {"extract": {"facts": ["The mill is open."]}}, scope="run")
    bench.step("a mill")
    bench.end()
    assert bench.asked == [] and bench.shown("mill") == "- The mill is open. [episode 1, step 1]"
    assert bench.purposes() == ["extract"]
    bench.shown("mill")
    assert bench.purposes() == ["extract"]  # once


def test_parameters_out_of_range_are_refused() -> None:
    for params in ({"every": 0}, {"messages": -1}, {"decide": "never"}, {"preset": "papr"}):
        with pytest.raises(SpecError):
            Bench({"name": "mem0", **params})


def test_mem0_recalls_what_a_short_window_has_lost() -> None:
    memory = {"name": "mem0", "preset": "rl", "every": 4, "capacity": 500, "similar": 1}
    keep = {"update": lambda request: json.dumps(add_all(request))}
    assert not succeeds({"name": "base", "window": 5})
    assert succeeds(memory, curate=keep) and succeeds(memory, scope="run", curate=keep)


def test_nothing_is_asked_when_an_earlier_episode_left_nothing_after_all() -> None:
    bench = Bench(ONE, {"extract": [{"facts": ["The key is red."]}]})
    bench.memory._left = True  # steps were left, and written since, before anything was recalled
    bench.recall("a key")
    assert bench.purposes() == []


def test_a_long_answer_of_the_environment_does_not_fill_the_recall() -> None:
    bench = Bench({"name": "mem0", "recent": 3, "every": 9, "step_tokens": 60}, {})
    bench.step("a town", "LOOK()", "street\n" * 400)
    (item,) = bench.recall("a town").items
    assert item.text.startswith("1. LOOK() -> street street") and len(item.text) <= 60  # a token is a byte here


def test_a_decision_has_room_to_repeat_every_fact() -> None:
    facts = [
        f"Restaurant {i} at (139.6m, 24.0m) had the food of order {i} ready 5 min after it was accepted."
        for i in range(4)
    ]
    asked = Asked(extract=json.dumps({"facts": facts}), update=json.dumps(ops()))
    learn(Mem0Memory(services(asked), preset="rl", every=1), step(0, "a town"), step(1, "a town"))
    room = asked.requests[asked.purposes.index("update")].sampling.max_tokens
    assert room >= estimate_tokens(json.dumps(ops(*(("UPDATE", i, fact) for i, fact in enumerate(facts)))))
