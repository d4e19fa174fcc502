"""ACE: deltas by name, counters by verdict, merging of near-duplicates, a budget; and the three roles around them."""

from __future__ import annotations

import asyncio
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.memory.ace import ACE
from agentspec.memory.ace.playbook import Bullet, Operation, Playbook
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.state import joined
from agentspec.structured import json_of
from agentspec.tokens import estimate_tokens
from tests.memory.one_step import TASK, Asked, episode, seen, services, step
from tests.memory.recall_world import succeeds

REVIEW = json.dumps({"insight": "Look first."})


def adds(*texts: str, section: str = "STRATEGIES") -> str:
    return json.dumps({"operations": [{"type": "ADD", "section": section, "content": t} for t in texts]})


def book(*rows: tuple) -> Playbook:
    return Playbook(Bullet(*row) for row in rows)


def learn(memory: ACE, *steps) -> None:
    for s in steps:
        asyncio.run(memory.store(s))


def shown(memory: ACE, k: int | None = None) -> list[str]:
    return [i.text for i in asyncio.run(memory.retrieve(seen("now"), k)).items]


# -- the playbook ---------------------------------------------------------------------------------------------------


def test_deltas_touch_only_what_they_name() -> None:
    playbook = book((0, "STRATEGIES", "a", 2, 1), (1, "FACTS", "b"), (2, "OTHERS", "c", 0, 3), (3, "FACTS", "d"))
    numbers = iter(range(4, 10))
    for op in (
        Operation("UPDATE", id="fac-00001", content="b2"),
        Operation("REMOVE", id="fac-00003"),
        Operation("ADD", section="weather", content="rain"),
        Operation("ADD", section="facts", content="B2"),  # word for word what is there: nothing
        Operation("UPDATE", id="fac-00009", content="nobody"),
        Operation("UPDATE", id="str-00000", content=""),
    ):
        playbook.apply(op, lambda: next(numbers))
    assert [b.line() for b in playbook] == [
        "[str-00000] helpful=2 harmful=1 :: a",
        "[fac-00001] helpful=0 harmful=0 :: b2",
        "[oth-00002] helpful=0 harmful=3 :: c",
        "[oth-00004] helpful=0 harmful=0 :: rain",  # an unknown section is OTHERS
    ]
    assert next(numbers) == 5  # what is not added takes no number


@given(st.lists(st.tuples(st.sampled_from(["UPDATE", "REMOVE", "MERGE", "ADD"]), st.integers(0, 7), st.integers(0, 7))))
def test_whatever_is_not_named_stays_as_it_is(deltas: list[tuple[str, int, int]]) -> None:
    playbook = book(*((i, "FACTS", f"text {i}", i, 1) for i in range(6)))
    before = {b.id: b for b in playbook}
    named: set[str] = set()
    number = iter(range(100, 1000))
    for kind, a, b in deltas:
        ids = (f"fac-{a:05d}", f"fac-{b:05d}")
        op = Operation(kind, "FACTS", ids[0], ids, f"{kind} {a} {b}")  # type: ignore[arg-type]
        named |= set(ids) if kind == "MERGE" else {ids[0]} if kind != "ADD" else set()
        playbook.apply(op, lambda: next(number))
    after = {b.id: b for b in playbook}
    assert all(after.get(id) == bullet for id, bullet in before.items() if id not in named)


def test_a_merge_sums_counters_under_the_oldest_id() -> None:
    playbook = book((1, "FACTS", "a", 2, 1), (2, "STRATEGIES", "b", 3, 0), (3, "FACTS", "c"))
    merged = playbook.merge(["str-00002", "fac-00001", "fac-00001", "fac-00077"], "ab")
    assert merged == Bullet(1, "FACTS", "ab", 5, 1) and [b.number for b in playbook] == [1, 3]
    assert playbook.merge(["fac-00003", "fac-00003"], "alone") is None


def test_verdicts_count_and_ids_nobody_has_do_not() -> None:
    playbook = book((0, "FACTS", "a"))
    assert playbook.tag("fac-00000", "helpful") and playbook.tag("fac-00000", "harmful")
    assert playbook.tag("fac-00000", "neutral") and not playbook.tag("str-00000", "helpful")
    assert playbook["fac-00000"].line() == "[fac-00000] helpful=1 harmful=1 :: a"
    assert playbook.cited("As [fac-00000] says, and fac-00000; not [str-00001], xfac-00000.") == ["fac-00000"]


def test_over_budget_what_harms_as_often_as_it_helps_goes_first() -> None:
    # Balances: 0: +2, 1: -1, 2: 0, 3: 0, 4: +1. So 1 goes first, then 2 (the older of the two with 0), then 3, then 4.
    rows = [
        (0, "FACTS", "a", 2, 0),
        (1, "FACTS", "b", 1, 2),
        (2, "FACTS", "c", 1, 1),
        (3, "FACTS", "d"),
        (4, "FACTS", "e", 1),
    ]
    for most, left in ((5, [0, 1, 2, 3, 4]), (4, [0, 2, 3, 4]), (2, [0, 4]), (1, [0])):
        playbook = book(*rows)
        playbook.prune(10_000, most, len)
        assert [b.number for b in playbook] == left
    # A line is "[fac-00000] helpful=2 harmful=0 :: a": 36 characters and a break; three take 111 of them.
    playbook = book(*rows)
    assert [b.number for b in playbook.prune(111, 100, len)] == [1, 2]


def test_operations_are_read_one_by_one() -> None:
    raw = [
        {"type": "add", "content": "x"},
        {"type": "FLY"},
        7,
        {"type": "REMOVE", "id": 3},
        {"type": "REMOVE", "id": "fac-00001"},
    ]
    parse = json_of({"operations": list[Operation]}, whole=False)
    assert parse.salvage is not None and parse.salvage(json.dumps({"operations": raw})) == (
        {"operations": [Operation("ADD", content="x"), Operation("REMOVE", id="fac-00001")]},
        3,
    )


# -- the roles ------------------------------------------------------------------------------------------------------


def test_reflection_then_curation_then_the_next_prompt() -> None:
    review = {"error": "Too early.", "cause": "Not ready.", "correct": "Wait 60s.", "insight": "Read the clock."}
    script = Asked(reflect=json.dumps(review), curate=adds("Wait before TAKE().", "Orders are ready after 60s."))
    memory = ACE(services(script), dedupe=0)
    memory.begin_episode(TASK)
    learn(memory, step(0, "At the kitchen.", "TAKE()", error="not ready", reward=-1.0))
    assert script.purposes == ["reflect", "curate"]
    assert "Result: not ready" in script.prompt(0) and "Bullets" not in script.prompt(0).split("Steps (data")[1]
    assert "Wrong: Too early. Why: Not ready. Right: Wait 60s. Insight: Read the clock." in script.prompt(1)
    assert "(0 bullets, 0 of 4096 tokens)" in script.prompt(1)
    assert shown(memory)[1:] == [
        "[str-00000] helpful=0 harmful=0 :: Wait before TAKE().",
        "[str-00001] helpful=0 harmful=0 :: Orders are ready after 60s.",
        "Last review: Wait 60s.",
    ]


def test_bullets_that_the_thought_names_are_shown_to_the_reflector_and_counted() -> None:
    verdicts = [{"id": "str-00001", "tag": "helpful"}, {"id": "str-00009", "tag": "harmful"}]
    script = Asked(
        reflect=[REVIEW, json.dumps({"insight": "i", "bullets": verdicts})], curate=[adds("one", "two"), adds()]
    )
    memory = ACE(services(script), dedupe=0)
    learn(memory, step(0, "s0"), step(1, "s1", "GO(1)", thought="As [str-00001] says.\nAction: GO(1)"))
    asked = script.prompt(2)
    assert "Bullets that the agent named:\n[str-00001] helpful=0 harmful=0 :: two\n\n" in asked
    assert "Bullets named: str-00001" in asked and ":: one" not in asked
    assert [b.line()[12:31] for b in memory.playbook] == ["helpful=0 harmful=0", "helpful=1 harmful=0"]


def test_malformed_answers_change_nothing_and_the_review_waits() -> None:
    script = Asked(reflect=["prose", REVIEW, REVIEW], curate=["[1, 2", '{"operations": [{"type": "ADD"}, 3]}'])
    memory = ACE(services(script), dedupe=0, repairs=0)
    learn(memory, step(0, "s0"))
    assert script.purposes == ["reflect"]  # no review, nothing to curate; the step waits
    before = memory.playbook.state()
    learn(memory, step(1, "s1"))
    assert "State: s0" in script.prompt(1) and "State: s1" in script.prompt(1)
    assert memory.playbook.state() == before == joined([])
    learn(memory, step(2, "s2"))
    assert script.prompt().count("- Insight: Look first.") == 2  # the review whose curation failed, and the new one
    assert memory.playbook.state() == joined([])
    assert dict(memory.services.llm.recorder.problems) == {("memory.m", "malformed"): 3, ("memory.m", "rejected"): 1}


@pytest.mark.parametrize("merge", ["llm", "best"])
def test_near_duplicates_are_merged_at_the_threshold_and_counted_together(merge: str) -> None:
    # Words a, b, c, d and pairs "a b", "b c", "c d": 7 features; "a b c e" shares 5: 5 / 7 = 0.714.
    first, near, far = "a b c d", "a b c e", "x y"
    tags = json.dumps({"insight": "i", "bullets": [{"id": "str-00000", "tag": "helpful"}]})
    for dedupe, merged in ((0.72, False), (0.71, True)):
        script = Asked(reflect=[REVIEW, tags], curate=[adds(first, far), adds(near)], merge="both")
        memory = ACE(services(script), dedupe=dedupe, merge=merge)  # type: ignore[arg-type]
        learn(memory, step(0, "s0"), step(1, "s1"))
        assert ("merge" in script.purposes) == (merged and merge == "llm")
        text = "both" if merge == "llm" else first  # the one found helpful
        expected = [(0, text, 1), (1, far, 0)] if merged else [(0, first, 1), (1, far, 0), (2, near, 0)]
        assert [(b.number, b.text, b.helpful) for b in memory.playbook] == expected


def test_a_merge_that_says_nothing_leaves_the_group() -> None:
    script = Asked(reflect=REVIEW, curate=[adds("a b c"), adds("A, b c")], merge="")
    memory = ACE(services(script))
    learn(memory, step(0, "s0"), step(1, "s1"))
    assert script.purposes[-1] == "merge" and [b.text for b in memory.playbook] == ["a b c", "A, b c"]


def test_the_playbook_keeps_its_budget() -> None:
    # "[str-00000] helpful=0 harmful=0 :: note 0" is 41 characters: 11 tokens, and one for its break.
    script = Asked(reflect=REVIEW, curate=[adds(f"note {i}") for i in range(6)])
    memory = ACE(services(script), dedupe=0, playbook_tokens=36)
    learn(memory, *(step(i, f"s{i}") for i in range(6)))
    assert [b.text for b in memory.playbook] == ["note 3", "note 4", "note 5"]
    assert memory.metrics()["dropped"] == 3 and memory.metrics()["added"] == 6


def test_what_an_episode_leaves_is_reflected_on_when_the_next_one_begins() -> None:
    script = Asked(reflect=REVIEW, curate=adds("one"))
    memory = ACE(services(script), every=0, dedupe=0)
    steps = (step(0, "s0", reward=1.0), step(1, "s1", ended=True))
    learn(memory, *steps)
    asyncio.run(memory.end_episode(episode(*steps, success=True)))
    assert not script.requests
    other = ACE(services(script), every=0, dedupe=0)
    other.restore(memory.snapshot())
    other.begin_episode(TASK)
    assert len(shown(other)) == 3 and script.purposes == ["reflect", "curate"]
    assert "The episode ended after 2 steps. Return: +1.00, a success." in script.prompt(0)
    assert len(memory.playbook) == 0  # the copy shares nothing


def test_what_matters_most_is_shown_within_the_budget() -> None:
    memory = ACE(services(Asked()))
    memory.playbook = book((0, "STRATEGIES", "a", 0, 1), (1, "FACTS", "b", 3, 0), (2, "FACTS", "c", 1, 0))
    assert [line[1:10] for line in shown(memory, 2)[1:]] == ["fac-00001", "fac-00002"]
    recall = asyncio.run(memory.retrieve(seen("x")))
    # The header is 71 characters, a line 36; the two best lines and the header make 71 + 1 + 36 + 1 + 36 = 145.
    assert [line[:10] for line in recall.render(145, len).splitlines()] == ["Playbook (", "[fac-00001", "[fac-00002"]


def test_parameters() -> None:
    for params, message in (({"dedupe": 2.0}, "dedupe"), ({"repairs": 2}, "repairs"), ({"merge": "vote"}, "merge")):
        with pytest.raises(SpecError, match=message):
            AgentSpec.from_data({"memory": {"name": "ace", **params}})
    assert AgentSpec.from_data({"memory": "ace"}).needs() == {"embedder"}
    assert AgentSpec.from_data({"memory": {"name": "ace", "dedupe": 0}}).needs() == set()


@pytest.mark.parametrize("scope", ["episode", "run"])
@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("preset", ["paper", "rl"])
def test_a_fact_seen_long_ago_is_in_the_playbook(preset: str, layout: str, scope: str) -> None:
    assert succeeds({"name": "ace", "preset": preset}, scope=scope, layout=layout)


def test_the_newest_bullets_and_the_last_review_are_shown_where_not_all_fit() -> None:
    memory = ACE(services(Asked()), dedupe=0)
    for i in range(40):
        memory.playbook.apply(
            Operation("ADD", "FACTS", content=f"Fact number {i} about the mill."), memory.services.new_id
        )
    memory.playbook.tag("fac-00003", "helpful")
    memory._last = "Look before you leap."
    shown = asyncio.run(memory.retrieve(seen("now"))).render(300, estimate_tokens)
    assert "Last review: Look before you leap." in shown and "number 3 " in shown
    assert "number 39 " in shown and "number 0 " not in shown


def test_ids_are_read_in_brackets_and_a_strange_tag_loses_no_review() -> None:
    playbook = Playbook([Bullet(0, "STRATEGIES", "Go."), Bullet(1, "STRATEGIES", "Run.")])
    new = iter(range(2, 9)).__next__
    assert playbook.apply(Operation("UPDATE", id="[str-00000]", content="Walk."), new) == Bullet(
        0, "STRATEGIES", "Walk."
    )
    assert playbook.tag("[str-00001]", "helpful") and not playbook.tag("[str-00009]", "helpful")
    assert playbook.merge(["[str-00000]", "[str-00001]"], "Walk or run.") == Bullet(0, "STRATEGIES", "Walk or run.", 1)
    assert playbook.apply(Operation("REMOVE", id="[str-00000]"), new) is None and len(playbook) == 0
    tags = [{"id": "str-00000", "tag": "Helpful"}, {"id": "str-00001", "tag": "useful"}]
    script = Asked(reflect=json.dumps({"insight": "Go.", "bullets": tags}), curate='{"operations": []}')
    memory = ACE(services(script), dedupe=0)
    memory.playbook = Playbook([Bullet(0, "STRATEGIES", "Go."), Bullet(1, "STRATEGIES", "Run.")])
    learn(memory, step(0, "a"))
    assert [b.helpful for b in memory.playbook] == [1, 0] and script.purposes == ["reflect", "curate"]
