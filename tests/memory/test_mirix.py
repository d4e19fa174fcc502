"""MIRIX: routing, one edit per manager, merges that keep ids, the core's rewrite, quotas and tags."""

from __future__ import annotations

import json

import pytest

from agentspec.memory.mirix import Edit, Mirix
from agentspec.registry import SpecError
from tests.memory.by_hand import TASK, Asked, learn, recall, services, step
from tests.memory.recall_world import succeeds


def edit(op: str, id: int | None = None, **fields: str) -> str:
    return json.dumps({"op": op, "id": id, "fields": fields})


def mirix(script=None, **params) -> Mirix:
    return Mirix(services(script), **{"topic": "state", "recent": 0, **params})


def test_the_meta_manager_routes_and_each_manager_edits_once() -> None:
    asked = Asked(
        route='{"stores": ["vault", "nonsense", "episodic", "vault"]}', edit=edit("insert", value="7", event="Began.")
    )
    memory = mirix(asked, every=2)
    learn(memory, step(0, "a"), step(1, "b"))
    assert asked.purposes == ["route", "edit", "edit"]
    assert [(e.store, e.text) for e in memory.entries.values()] == [("vault", "7"), ("episodic", "Began.")]
    assert "Edit the store `vault`" in asked.prompt(1) and "Step 2: WAIT() -> done | in: b" in asked.prompt(1)


def test_merge_and_update_keep_the_id() -> None:
    memory = mirix()
    memory._apply("semantic", Edit("insert", fields={"name": "mill", "details": "closed"}))
    memory._apply("semantic", Edit("merge", 0, {"details": "opens at 9"}))
    assert (list(memory.entries), memory.entries[0].text) == ([0], "mill | closed; opens at 9")
    memory._apply("semantic", Edit("update", 0, {"details": "open"}))
    assert (list(memory.entries), memory.entries[0].text) == ([0], "mill | open")
    assert recall(memory, "mill") == ["[semantic] mill | open"]


@pytest.mark.parametrize(
    ("store", "change"),
    [
        ("semantic", Edit("merge", 9, {"name": "x"})),
        ("semantic", Edit("update", None, {"name": "x"})),
        ("vault", Edit("update", 0, {"value": "x"})),  # 0 is an entry of another store
        ("semantic", Edit("insert", fields={"colour": "red"})),
        ("semantic", Edit("insert", fields={"name": " "})),
        ("semantic", Edit("insert", fields={"name": "mill"})),
        ("attic", Edit("insert", fields={"name": "x"})),
    ],
)
def test_edits_that_fit_no_schema_or_entry_change_nothing(store: str, change: Edit) -> None:
    memory = mirix()
    memory._apply("semantic", Edit("insert", fields={"name": "mill"}))
    before = dict(memory.entries)
    memory._apply(store, change)
    assert memory.entries == before and memory.metrics()["refused_edits"] == 1


@pytest.mark.parametrize(("text", "rewrites"), [("x" * 17, 0), ("x" * 18, 1)])
def test_core_memory_is_rewritten_when_nine_tenths_are_full(text: str, rewrites: int) -> None:
    # 0.9 of 20 characters are 18.
    asked = Asked(route='{"stores": ["core"]}', edit=edit("insert", text=text), rewrite="Short.")
    memory = mirix(asked, every=1, core_chars=20)
    learn(memory, step(0, "a"))
    assert asked.purposes.count("rewrite") == rewrites and memory.core == ("Short." if rewrites else text)


def test_one_call_may_edit_all_stores_once_each() -> None:
    edits = [
        {"store": "vault", "op": "insert", "fields": {"name": "code", "value": "7"}},
        {"store": "vault", "op": "insert", "fields": {"name": "second", "value": "8"}},
        {"store": "core", "op": "update", "fields": {"text": "Find the code."}},
    ]
    asked = Asked(edit_all=json.dumps({"edits": edits}))
    memory = mirix(asked, preset="rl", every=1)
    learn(memory, step(0, "a"))
    assert asked.purposes == ["edit_all"] and recall(memory, "code") == ["[core] Find the code.", "[vault] code | 7"]
    learn(memory, step(1, "the code"))
    assert "0 [vault] code | 7" in asked.prompt(1)


def test_every_store_gives_its_quota_with_its_tag() -> None:
    memory = mirix(top=2)
    for i in range(3):
        memory._apply("episodic", Edit("insert", fields={"event": f"key {i}"}))
        memory._apply("procedural", Edit("insert", fields={"summary": f"key {i}"}))
    tags = [text.split()[0] for text in recall(memory, "key")]
    assert tags == ["[episodic]"] * 2 + ["[procedural]"] * 2


def test_the_topic_is_the_models_or_the_observation() -> None:
    for answer, expected in (('{"topic": "red door"}', "[vault] red door"), ("no topic", "[vault] blue key")):
        memory = mirix(Asked(topic=answer), topic="llm", top=1)
        for name in ("blue key", "red door"):
            memory._apply("vault", Edit("insert", fields={"name": name}))
        assert recall(memory, "a blue key") == [expected]


@pytest.mark.parametrize("answer", ["", "prose", '{"stores": 3}', '{"stores": ["attic"]}'])
def test_a_bad_answer_edits_nothing(answer: str) -> None:
    memory = mirix(Asked(route=answer, edit=answer), every=1)
    learn(memory, step(0, "a"))
    assert not memory.entries and not memory.core
    assert bool(memory.services.llm.recorder.problems) == ("attic" not in answer)


def test_snapshots_are_exact_and_stores_are_bounded() -> None:
    memory = mirix(max_entries=2)
    for i in range(4):
        memory._apply("vault", Edit("insert", fields={"name": f"n{i}"}))
    memory._apply("vault", Edit("merge", 2, {"value": "v"}))
    assert list(memory.entries) == [3, 2]
    learn(memory, step(0, "a"))
    other = mirix(max_entries=2)
    other.restore(memory.snapshot())
    assert other.snapshot() == memory.snapshot() and recall(other, "n2") == recall(memory, "n2")
    assert "[vault] 2: n2 | v" in memory.describe()


def test_bad_parameters_are_refused() -> None:
    for bad in ({"routing": "x"}, {"topic": "x"}, {"every": 0}, {"preset": "x"}):
        with pytest.raises(SpecError, match="mirix"):
            mirix(**bad)


@pytest.mark.parametrize("layout", ["snapshot", "conversation"])
@pytest.mark.parametrize("scope", ["episode", "run"])
def test_a_fact_seen_long_ago_decides(scope: str, layout: str) -> None:
    assert not succeeds({"name": "base", "window": 5}, scope=scope, layout=layout)
    for preset in ("paper", "rl"):
        assert succeeds({"name": "mirix", "preset": preset}, scope=scope, layout=layout)


def test_what_an_earlier_episode_left_says_so_and_an_event_says_when() -> None:
    asked = Asked(edit_all='{"edits": []}')
    memory = mirix(asked, routing="single", every=1)
    memory.services.clock.step = 4
    memory._apply("core", Edit("insert", fields={"text": "Order 3 is in the bag."}))
    memory._apply("vault", Edit("insert", fields={"name": "mill"}))
    memory._apply("episodic", Edit("insert", fields={"event": "Met the miller."}))
    here = ["[core] Order 3 is in the bag.", "[episodic] Met the miller. [up to step 4]", "[vault] mill"]
    assert recall(memory, "mill") == here
    memory.services.clock.episode = 1
    memory.begin_episode(TASK)
    old = ["[core, as of an earlier episode] Order 3 is in the bag."]
    old += ["[episodic] Met the miller. [episode 1, up to step 4]", "[vault] mill [episode 1]"]
    assert recall(memory, "mill") == old
    learn(memory, step(0, "mill"))
    assert "[core, as of an earlier episode]" in asked.prompt() and "[vault] mill [episode 1]" in asked.prompt()
    memory._apply("core", Edit("update", fields={"text": "Order 4 is new."}))
    assert recall(memory, "mill")[0] == "[core] Order 4 is new."


@pytest.mark.parametrize(("written", "kept"), [("Short.", "Short."), ("", "ORD 10 is at the quay.")])
def test_the_core_is_rewritten_before_anything_of_it_is_cut(written: str, kept: str) -> None:
    added = edit("insert", text="ORD 10 is at the quay.")
    asked = Asked(route='{"stores": ["core"]}', edit=added, rewrite=written)
    memory = mirix(asked, every=1, core_chars=40)
    memory.core = "The agent is a courier with a car."
    learn(memory, step(0, "a"))
    assert "The agent is a courier with a car.\nORD 10 is at the quay." in asked.prompt()  # whole, 57 of 40 signs
    assert memory.core.endswith(kept) and len(memory.core) <= 40
