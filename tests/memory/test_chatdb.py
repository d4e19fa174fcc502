"""ChatDB: real SQL against a Python oracle, the chain with its placeholders, and what a model's SQL may not do."""

from __future__ import annotations

import asyncio
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agentspec.context import Context
from agentspec.memory.chatdb import ChatDB, Database, place_of
from agentspec.registry import SpecError
from tests.memory.by_hand import Asked, learn, recall, seen, services, step
from tests.memory.recall_world import succeeds

ROWS = st.lists(st.tuples(st.sampled_from(["GO", "TAKE"]), st.integers(0, 1), st.integers(-3, 3)), max_size=12)


def chain(*links: tuple[str, str]) -> str:
    return json.dumps({"steps": [{"about": about, "sql": sql} for about, sql in links]})


def db(script=None, **params) -> ChatDB:
    return ChatDB(services(script), **{"mode": "template", **params})


def filled(rows=(), instructions: int = 1_000_000) -> Database:
    base = Database(instructions)
    for i, (action, ok, reward) in enumerate(rows):
        base.add((None, 0, i, "", f"state {i}", action, "", ok, "done", float(reward)))
    return base


@given(ROWS)
@settings(deadline=None, max_examples=50)
def test_aggregates_and_joins_are_right(rows: list[tuple[str, int, int]]) -> None:
    base = filled(rows)
    total = {a: sum(r for b, _, r in rows if a == b) for a in ("GO", "TAKE")}
    for action, expected in total.items():
        got = base.run(f"SELECT total(reward) AS t FROM steps WHERE action = '{action}'", 5)
        assert got == f"t: {float(expected)}"
    pairs = sum(a == b and r < s for a, _, r in rows for b, _, s in rows)
    sql = "SELECT count(*) AS n FROM steps a JOIN steps b ON a.action = b.action AND a.reward < b.reward"
    assert base.run(sql, 5) == f"n: {pairs}"


@pytest.mark.parametrize(
    "sql",
    [
        "DROP TABLE steps",
        "DELETE FROM steps",
        "UPDATE steps SET reward = 9",
        "INSERT INTO steps (action) VALUES ('x')",
        "CREATE TABLE t (x)",
        "ATTACH DATABASE '/tmp/x.db' AS y",
        "PRAGMA writable_schema = 1",
        "SELECT load_extension('x')",
        "SELECT readfile('/etc/passwd')",
        "SELECT randomblob(9)",
        "SELECT sql FROM sqlite_master",
        "VACUUM INTO '/tmp/x.db'",
        "BEGIN",
        "SELECT 1; DROP TABLE steps",
        "no SQL at all",
        "",
    ],
)
def test_what_a_model_may_not_do(sql: str) -> None:
    base = filled([("GO", 1, 1)])
    before = base.state()
    result = base.run(sql, 5)
    assert result.startswith("error: ") or (not sql and result == "done (0 rows)"), result
    assert base.state() == before and base.run("SELECT count(*) AS n FROM steps", 5) == "n: 1"


def test_a_runaway_query_is_stopped_and_the_next_one_runs() -> None:
    base = filled([("GO", 1, 1)], instructions=20_000)
    endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT count(x) FROM c"
    assert base.run(endless, 5) == "error: stopped, it takes too long"
    assert base.run("SELECT action FROM steps", 5) == "action: GO"


def test_rows_are_capped_and_notes_can_be_kept() -> None:
    base = filled([("GO", 1, i) for i in range(4)])
    assert base.run("SELECT reward FROM steps", 2) == "reward: 0.0\nreward: 1.0\n(more rows are left out)"
    assert base.run("INSERT INTO notes (note) VALUES ('the code is 7')", 5) == "done (1 rows)"
    assert base.run("SELECT note FROM notes", 5) == "note: the code is 7"
    assert base.run("SELECT note FROM notes WHERE 0", 5) == "no rows"
    assert base.trim(2, 0) == 3  # two of four steps, and the note


def test_a_chain_fills_placeholders_from_the_results_before() -> None:
    links = chain(
        ("worst action", "SELECT action FROM steps ORDER BY reward LIMIT 1"),
        ("how often", "SELECT count(*) AS n FROM steps WHERE action = '<worst action>'"),
    )
    asked = Asked(query=links, fill='{"sql": "SELECT count(*) AS n FROM steps WHERE action = \'TAKE\'"}')
    memory = db(asked, mode="chain", recent=0)
    learn(memory, step(0, "a", "GO(1)"), step(1, "b", "TAKE(2)", reward=-1.0), step(2, "c", "TAKE(3)"))
    assert recall(memory, "now") == ["worst action:\naction: TAKE", "how often:\nn: 2"]
    assert asked.purposes == ["query", "fill"]
    assert "Actions so far: TAKE x2, GO x1" in asked.prompt(0) and "worst action:\naction: TAKE" in asked.prompt(1)
    assert "SQL: SELECT count(*) AS n FROM steps WHERE action = '<worst action>'" in asked.prompt(1)


def test_an_error_is_told_in_words_and_counted() -> None:
    memory = db(Asked(query=chain(("x", "SELECT missing FROM steps"))), mode="chain", recent=0)
    learn(memory, step(0, "a"))
    assert recall(memory, "now") == ["x:\nerror: no such column: missing"]
    assert memory.metrics()["sql_errors"] == 1


@pytest.mark.parametrize("answer", ["", "prose", '{"steps": [{"sql": 1}]}', '{"steps": []}'])
def test_a_bad_or_empty_answer_shows_the_newest_steps_alone(answer: str) -> None:
    memory = db(Asked(query=answer), mode="chain", recent=1)
    learn(memory, step(0, "a"), step(1, "b"))
    assert recall(memory, "now") == ["Step 2: WAIT() -> done | in: b"]
    assert bool(memory.services.llm.recorder.problems) == (answer != '{"steps": []}')


def test_a_failed_fill_ends_the_chain() -> None:
    asked = Asked(query=chain(("a", "SELECT '<x>'"), ("b", "SELECT 1")), fill="no")
    memory = db(asked, mode="chain", recent=0)
    learn(memory, step(0, "a"))
    assert recall(memory, "now") == []


def test_templates_show_each_step_once() -> None:
    memory = db(recent=1, rows=2)
    learn(
        memory,
        step(0, "hall", "GO(1)", reward=2.0),
        step(1, "hall", "TAKE(1)", error="hands full"),
        step(2, "hall", "TAKE(1)", error="hands full"),
        step(3, "hall", "GO(2)", reward=-1.0),
        step(4, "hall", "WAIT()"),
    )
    # The failure stands once, by its newest step; step 5 is shown as the newest.
    assert recall(memory, "hall") == [
        "Failed before:\nStep 3: TAKE(1) failed: hands full | in: hall",
        "Best rewards:\nStep 1: GO(1) -> done (+2.00) | in: hall",
        "Worst rewards:\nStep 4: GO(2) -> done (-1.00) | in: hall",
        "Step 5: WAIT() -> done | in: hall",
    ]


def test_the_same_place_is_found() -> None:
    assert [place_of(s) for s in ({"place": "mill"}, {"place": "", "position": [1.2, 3]}, {"x": 1})] == [
        "mill",
        "1, 3",
        "",
    ]
    memory = db(recent=0, rows=1)
    for i, place in enumerate(("mill", "quay", "mill", "quay")):
        here = step(i, f"state {i}", f"GO({i})")
        object.__setattr__(here.input, "state", {"place": place})
        learn(memory, here)
    now = seen("now")
    object.__setattr__(now, "state", {"place": "mill"})
    first = asyncio.run(memory.retrieve(now)).items[0].text
    assert first == "At this place before:\nStep 3: GO(2) -> done | in: state 2"


def test_a_conversation_shows_its_own_steps() -> None:
    context = Context("conversation")
    memory = ChatDB(services(context=context), preset="rl")
    context.prompt("", "a")
    context.close(("x",))
    learn(memory, step(0, "a", error="no"))
    assert recall(memory, "now") == []


def test_snapshots_are_exact_and_bounded() -> None:
    memory = db(max_rows=3, max_notes=1)
    learn(memory, *(step(i, f"room {i}", reward=0.1 * i) for i in range(5)))
    for note in ("a", "b"):
        memory.db.run(f"INSERT INTO notes (note) VALUES ('{note}')", 1)
    memory.db.trim(3, 1)
    other = db(max_rows=3, max_notes=1)
    other.services.clock.step = memory.services.clock.step
    other.restore(memory.snapshot())
    assert other.snapshot() == memory.snapshot() and recall(other, "x") == recall(memory, "x")
    assert other.metrics()["rows"] == 3 and other.metrics()["notes"] == 1
    learn(other, step(5, "room 5"))
    assert [i for (i,) in other.db.rows("SELECT id FROM steps")] == [4, 5, 6]
    assert "- b" in other.describe()


def test_bad_parameters_are_refused() -> None:
    for bad in ({"mode": "x"}, {"rows": 0}, {"preset": "x"}):
        with pytest.raises(SpecError, match="chatdb"):
            db(**bad)


@pytest.mark.parametrize("layout", ["snapshot", "conversation"])
@pytest.mark.parametrize("scope", ["episode", "run"])
def test_a_fact_seen_long_ago_decides(scope: str, layout: str) -> None:
    assert not succeeds({"name": "base", "window": 5}, scope=scope, layout=layout)
    look = chain(("notices", "SELECT state FROM steps WHERE state LIKE '%notice%' ORDER BY id DESC LIMIT 1"))
    assert succeeds({"name": "chatdb"}, scope=scope, layout=layout, curate={"query": look})
    assert succeeds({"name": "chatdb", "preset": "rl"}, scope=scope, layout=layout)


def test_rows_of_a_with_clause_can_be_counted_and_those_of_the_schema_cannot() -> None:
    database = Database()
    database.add((None, 0, 1, "p", "s", "GO", "1", 1, "ok", 1.0))
    assert database.run("WITH w AS (SELECT action FROM steps) SELECT count(*) AS n FROM w", 3) == "n: 1"
    for name in ("sqlite_master", "SQLITE_Schema", "pragma_database_list"):
        assert database.run(f"SELECT count(*) FROM {name}", 3).startswith("error: "), name
    endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT count(*) FROM c"
    assert database.run(endless, 3) == "error: stopped, it takes too long"


def test_no_statement_makes_a_note_of_megabytes() -> None:
    database, value = Database(), "'" + "a" * 20 + "'"
    for _ in range(4):
        value = f"replace({value}, 'a', '{'a' * 20}')"
    assert database.run(f"INSERT INTO notes(note) VALUES ({value})", 3).startswith("error: ")
    assert database.rows("SELECT count(*) FROM notes") == [(0,)]


def test_a_result_that_counts_steps_says_from_where() -> None:
    asked = Asked(query=chain(("worst", "SELECT step, reward FROM steps"), ("all", "SELECT count(*) FROM steps")))
    memory = db(asked, mode="chain", recent=0)
    learn(memory, step(0, "a", reward=-1.0))
    assert recall(memory, "b") == [
        "worst (steps and episodes count from 0):\nstep: 0, reward: -1.0",
        "all:\ncount(*): 1",
    ]
