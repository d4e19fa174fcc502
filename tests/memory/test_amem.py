"""A-Mem: the addressed notes change and no others, links lead somewhere, and what changed is found where it now is."""

from __future__ import annotations

import asyncio
import json

import pytest

from agentspec.memory.amem import AMem
from agentspec.memory.amem.notes import Note
from tests.memory.one_step import TASK, Asked, episode, seen, services, step
from tests.memory.recall_world import succeeds

PLAIN = json.dumps({"keywords": [], "context": "", "tags": []})
STAY = json.dumps({"evolve": False})


def evolution(**fields: object) -> str:
    return json.dumps({"evolve": True, **fields})


def learn(memory: AMem, *texts: str) -> None:
    start = len(memory.notes)
    for number, text in enumerate(texts, start):
        memory.services.clock.step = number + 1
        asyncio.run(memory.store(step(number, text)))


def recalled(memory: AMem, text: str, k: int | None = None) -> list[str]:
    """Names of the notes that are recalled, in order."""
    items = asyncio.run(memory.retrieve(seen(text), k)).items
    return [i.text[1 : i.text.index("]")] for i in items if i.text.startswith("[n")]


def test_a_note_describes_itself_and_the_first_one_has_nothing_to_evolve() -> None:
    analysis = {"keywords": ["mill", "mill", " order 3 "], "context": "Order 3 waits\nat the mill.", "tags": ["order"]}
    script = Asked(analyse=json.dumps(analysis))
    memory = AMem(services(script))
    learn(memory, "At the mill.")
    (note,) = memory.notes
    assert script.purposes == ["analyse"]
    assert (note.keywords, note.context, note.tags) == (["mill", "order 3"], "Order 3 waits at the mill.", ["order"])
    assert note.text() == "At the mill. 1. WAIT() -> done Order 3 waits at the mill. mill order 3 order"
    items = asyncio.run(memory.retrieve(seen("mill"))).items
    assert items[1].text == "[n0] Order 3 waits at the mill. (order)\nState: At the mill.\n1. WAIT() -> done"


def test_exactly_the_addressed_neighbours_change() -> None:
    change = evolution(
        links=["n2", "n99", "2", "[n0]"],
        tags=["tool"],
        neighbours=[
            {"id": "n1", "context": "The key opens the gate.", "tags": ["key", "gate"]},
            {"id": "n3", "context": "The new note cannot rewrite itself."},
            {"id": "n77", "context": "Nobody."},
        ],
    )
    script = Asked(analyse=PLAIN, evolve=[STAY, STAY, change])
    memory = AMem(services(script))
    learn(memory, "red key", "blue key", "green key")
    before = [n.text() for n in memory.notes]
    learn(memory, "gold key")
    first, second, third, new = memory.notes
    assert [first.text(), third.text()] == [before[0], before[2]]
    assert (second.context, second.tags) == ("The key opens the gate.", ["key", "gate"])
    assert (new.links, new.tags, new.context) == ([2, 0], ["tool"], "")  # directed: from the new note
    assert not first.links and not third.links and memory.metrics() == {"notes": 4, "links": 2, "evolved": 1}


def test_only_notes_that_were_shown_can_be_changed() -> None:
    change = evolution(links=["n0", "n1"], neighbours=[{"id": "n0", "context": "x"}, {"id": "n1", "context": "y"}])
    script = Asked(analyse=PLAIN, evolve=[STAY, change])
    memory = AMem(services(script), neighbours=1)
    learn(memory, "far hill", "red key", "red key again")
    assert "[n1]" in script.prompt() and "[n0]" not in script.prompt()
    assert [n.context for n in memory.notes] == ["", "y", ""] and memory.notes[2].links == [1]


def test_what_a_note_said_before_is_kept_and_a_missing_field_changes_nothing() -> None:
    contexts = [evolution(neighbours=[{"id": "n0", "context": f"c{i}"}]) for i in range(6)]
    script = Asked(analyse=json.dumps({"keywords": [], "context": "start", "tags": ["t"]}), evolve=contexts)
    memory = AMem(services(script), neighbours=10)
    learn(memory, *(f"key {i}" for i in range(7)))
    note = memory.notes[0]
    # start, c0, ..., c4 came before c5; the newest four are kept. No tags were given, so the tags stay.
    assert (note.context, note.history, note.tags) == ("c5", ["c1", "c2", "c3", "c4"], ["t"])


def test_an_evolved_note_is_found_by_what_it_says_now() -> None:
    change = evolution(neighbours=[{"id": "n0", "context": "harbour harbour crane", "tags": ["harbour"]}])
    script = Asked(analyse=PLAIN, evolve=[change])
    memory = AMem(services(script))
    learn(memory, "red key")
    before = memory._index.search("harbour crane", 1)[0][1]  # type: ignore[union-attr]
    learn(memory, "a crane lifts")
    ranked = memory._index.search("harbour crane", 2)  # type: ignore[union-attr]
    assert ranked[0][0] == 0 and ranked[0][1] > before


def test_links_are_followed_one_way_and_at_most_as_many_as_were_asked_for() -> None:
    memory = AMem(services(Asked(analyse=PLAIN, evolve=STAY)))
    learn(memory, "red key", "far hill", "old mill", "green boat")
    notes = memory.notes
    memory._change(notes[0], links=[1, 2, 9])  # 9 is gone
    assert recalled(memory, "red key", 1) == ["n0", "n1"]
    assert recalled(memory, "far hill", 1) == ["n1"]
    assert "over" not in memory._shown(notes[0])
    memory.services.clock.episode = 2  # step numbers of another episode are marked as such
    assert memory._shown(notes[0]) == "[n0]\n(Episode 1, over) State: red key\n1. WAIT() -> done"
    # The two nearest are n0 and, of the notes that share no word but the labels, one more; links fill up to two others.
    nearest, linked = recalled(memory, "red key", 2)[:2], recalled(memory, "red key", 2)[2:]
    assert nearest[0] == "n0" and linked == [n for n in ("n1", "n2") if n not in nearest]
    assert memory.notes[0].recalled == 3 and memory.notes[3].recalled == 2 * ("n3" in nearest)


@pytest.mark.parametrize("bad", ["", "prose", '{"keywords": "key"}', '{"keywords": ["k"], "context": 3}'])
def test_a_note_is_stored_whatever_the_model_answers(bad: str) -> None:
    memory = AMem(services(Asked(analyse=bad, evolve=bad)), repairs=0)
    learn(memory, "red key", "blue key")
    assert [n.context for n in memory.notes] == ["", ""] and recalled(memory, "blue key", 1) == ["n1"]
    assert memory.services.llm.recorder.problems["memory.m", "malformed"] == 3


def test_long_lists_are_cut() -> None:
    many = [f"k{i}" for i in range(40)]
    memory = AMem(services(Asked(analyse=json.dumps({"keywords": many, "context": "c", "tags": many}))))
    learn(memory, "red key")
    assert memory.notes[0].keywords == many[:8] and memory.notes[0].tags == many[:8]


def test_over_capacity_the_note_used_longest_ago_goes() -> None:
    memory = AMem(services(Asked(analyse=PLAIN, evolve=STAY)), capacity=2)
    learn(memory, "red key", "far hill")
    memory.services.clock.step = 5
    recalled(memory, "red key", 1)  # n0 is used at 5, n1 was written at 2
    memory.services.clock.step = 6
    asyncio.run(memory.store(step(5, "old mill")))
    assert [n.name for n in memory.notes] == ["n0", "n2"] and len(memory._index) == 2  # type: ignore[arg-type]


def test_steps_come_together_in_a_note_and_the_last_is_described_in_the_next_episode() -> None:
    script = Asked(analyse=json.dumps({"keywords": ["k"], "context": "c", "tags": []}), evolve=STAY)
    memory = AMem(services(script), every=2)
    steps = [step(i, f"s{i}", reward=0.5, ended=i == 2) for i in range(3)]
    for s in steps:
        asyncio.run(memory.store(s))
    items = [i.text for i in asyncio.run(memory.retrieve(seen("s2"))).items]
    assert "State: s0" in items[1] and "State: s1" in items[1] and items[2] == "3. WAIT() -> done (+0.50)"
    asyncio.run(memory.end_episode(episode(*steps)))
    assert script.purposes == ["analyse"]
    other = AMem(services(script), every=2)
    other.restore(memory.snapshot())
    assert other.snapshot() == memory.snapshot()
    other.begin_episode(TASK)
    recalled(other, "s2")
    assert script.purposes == ["analyse", "analyse", "evolve"]
    assert other.notes[1].context == "c" and memory.notes[1].context == ""  # a copy shares nothing
    assert other.notes[1].steps[-1] == ["", "The episode ended after 3 steps. Return: +1.50."]


def test_notes_are_named_by_ids_that_go_on() -> None:
    assert Note(7, [], 0).described("x") == "[n7]\nx"
    memory = AMem(services(Asked(analyse=PLAIN, evolve=STAY)), capacity=1)
    learn(memory, "a", "b")
    assert [n.name for n in memory.notes] == ["n1"]


@pytest.mark.parametrize("scope", ["episode", "run"])
@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
@pytest.mark.parametrize("preset", ["paper", "rl"])
def test_a_fact_seen_long_ago_is_recalled(preset: str, layout: str, scope: str) -> None:
    assert succeeds({"name": "amem", "preset": preset}, scope=scope, layout=layout)
