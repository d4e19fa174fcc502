"""SimpleMem: the gate, three ways to be found, depth by complexity, consolidation into an archive."""

from __future__ import annotations

import json
import math

import pytest

from agentspec.memory.parts.entries import Entry
from agentspec.registry import SpecError
from agentspec.services import Time
from tests.memory.bench import Bench, Rows
from tests.memory.recall_world import notes, succeeds

NAME = {"name": "simplemem", "repairs": 0, "recent": 0}
NO_NOTES = {"compress": {"notes": []}}


def written(*texts: str, **more: object) -> dict:
    return {"notes": [{"text": text, **more} for text in texts]}


def texts(bench: Bench) -> list[str]:
    return [e.text for e in bench.memory.entries]


def test_the_gate_drops_what_was_seen_before_and_lets_rewards_pass() -> None:
    bench = Bench({**NAME, "window": 9})
    bench.step("Mill 5 is open", "GO()", "went")
    bench.step("Mill 5 is open", "GO()", "went")  # the same again: novelty 0
    assert bench.memory.metrics()["dropped"] == 1
    bench.step("Mill 5 is open", "GO()", "went", reward=1.0)
    bench.step("Port 7 is shut", "GO()", "went")  # another state
    bench.step("Port 7 is shut", "GO()", error="the ferry is gone")  # the same state, another result
    assert bench.memory.metrics()["dropped"] == 1
    assert [s.time.step for s in bench.memory._window] == [0, 2, 3, 4]


def test_novelty_is_the_weighted_mean_of_new_names_and_dissimilarity() -> None:
    world = Rows({"Mill": [1.0, 0.0], "Port": [0.8, 0.6]})
    memory = Bench({**NAME, "weight": 0.25}, embedder=world).memory
    assert memory.novelty("Mill 5", []) == 1.0  # nothing to compare with
    # Names of "Port 5" are Port and 5, one of two new; cosine 0.8: 0.25 * 0.5 + 0.75 * 0.2.
    assert memory.novelty("Port 5", ["Mill 5"]) == pytest.approx(0.275, abs=1e-6)
    assert memory.novelty("Mill 5", ["Mill 5"]) == pytest.approx(0.0, abs=1e-6)


def test_windows_overlap_and_the_newest_notes_are_shown() -> None:
    bench = Bench({**NAME, "window": 2, "overlap": 1, "context": 1, "gate": 0.0, "consolidate": False}, {})
    bench.answers["compress"] = [written("Note a.", "Note b."), written("Note c.")]
    for i in range(4):
        bench.step(f"state {i}")
    assert texts(bench) == ["Note a.", "Note b.", "Note c."] and bench.purposes() == ["compress"] * 2
    second = bench.prompt("compress")
    assert "state 0" not in second and all(f"state {i}" in second for i in (1, 2, 3))
    assert "- Note b. [step 2]" in second and "Note a." not in second


def test_an_answer_that_cannot_be_read_leaves_the_steps_for_the_next_window() -> None:
    bench = Bench({**NAME, "window": 2, "overlap": 0, "gate": 0.0}, {"compress": ["?", written("A note.")]})
    for i in range(4):
        bench.step(f"state {i}")
    assert all(f"state {i}" in bench.prompt("compress") for i in range(4))
    assert texts(bench) == ["A note."] and bench.problems() == {"malformed": 1}


WORLD = {"alpha": [1.0, 0.0, 0.0], "meaning": [0.9, 0.43589, 0.0], "wordy": [0.0, 1.0, 0.0], "placed": [0.0, 0.0, 1.0]}


def three_ways() -> Bench:
    """A note like the query in meaning, one with a word of it, one with a place of it; and others."""
    bench = Bench({**NAME, "window": 1, "gate": 0.0, "consolidate": False, "overlap": 0}, {}, embedder=Rows(WORLD))
    bench.answers["compress"] = {
        "notes": [
            {"text": "meaning"},
            {"text": "wordy", "keywords": ["zeppelin"]},
            {"text": "placed", "place": "Old Mill 3"},
        ]
    }
    bench.step("anything")
    return bench


def test_each_way_finds_what_the_others_cannot(monkeypatch) -> None:
    bench = three_ways()
    monkeypatch.setattr("agentspec.memory.simplemem.SEMANTIC", 1)
    found = bench.memory.search("alpha zeppelin, at the old mill 3", 9)
    # Cosines 0.9, 0, 0; BM25 1 (scaled) for the one with the word; a match for the one with the place.
    assert [(e.text, round(s, 3)) for e, s in found] == [("meaning", 0.9), ("wordy", 0.5), ("placed", 0.5)]
    assert [e.text for e, _ in bench.memory.search("alpha", 9)] == ["meaning"]
    assert [e.text for e, _ in bench.memory.search("zeppelin", 1)] == ["wordy"]
    assert [e.text for e, _ in bench.memory.search("old mill 3 it is", 1)] == ["placed"]


def test_the_depth_grows_with_the_complexity_of_the_query() -> None:
    memory = Bench({**NAME, "top": 4, "depth": 1.0}).memory
    # floor(4 * (1 + names / 20)): 0 -> 4, 5 -> 5, 20 -> 8, more than 20 as 20.
    depths = [memory.depth_of(" ".join(f"Place{i}" for i in range(n))) for n in (0, 4, 5, 20, 40)]
    assert depths == [4, 4, 5, 8, 8]


def test_affinity_is_likeness_in_meaning_and_in_time() -> None:
    from agentspec.memory.parts.entries import Entry

    memory = Bench({**NAME, "beta": 0.7, "decay": 0.02}).memory
    a, b = Entry(0, "a", Time(0, 0, 0)), Entry(1, "b", Time(0, 50, 50))
    assert memory.affinity_of(a, b, 0.9) == pytest.approx(0.63 + 0.3 * math.exp(-1))


def merged(merge: object) -> Bench:
    rows = {"shop": [1.0, 0.0], "port": [0.0, 1.0]}
    memory = {**NAME, "window": 1, "gate": 0.0, "overlap": 0, "cluster": 3}
    said = [written(t, entities=[e]) for t, e in (("shop 1", "A"), ("port", "P"), ("shop 2", "B"), ("shop 3", "A"))]
    bench = Bench(memory, {"compress": said, "merge": merge}, embedder=Rows(rows))
    for i in range(4):
        bench.step(f"state {i}")
    return bench


def test_notes_that_are_alike_become_one_and_go_into_the_archive() -> None:
    bench = merged({"text": "All shops.", "entities": ["C"]})
    assert bench.purposes() == ["compress"] * 4 + ["merge"]
    assert texts(bench) == ["port", "All shops."] and [e.text for e in bench.memory.archive] == [
        "shop 1",
        "shop 2",
        "shop 3",
    ]
    note = list(bench.memory.entries)[-1]
    assert note.data["names"] == ["c", "a", "b"] and note.time.step == 3
    assert "port" not in bench.prompt("merge")
    # An archived note is not found any more, the new one by the names of all.
    assert [e.text for e, _ in bench.memory.search("b", 1)] == ["All shops."]


def test_a_merger_that_cannot_be_read_changes_nothing() -> None:
    bench = merged("no")
    assert texts(bench) == ["shop 1", "port", "shop 2", "shop 3"] and bench.memory.archive == []


def test_planning_asks_for_queries_and_at_most_twice_for_what_is_missing() -> None:
    bench = three_ways()
    bench.memory.plan, bench.memory.top = True, 1
    bench.answers |= {"plan": {"queries": ["zeppelin"]}, "check": {"enough": False, "queries": ["old mill 3"]}}
    assert [i.text.split(" [")[0] for i in bench.recall("alpha").items] == ["- meaning", "- wordy", "- placed"]
    assert bench.purposes()[1:] == ["plan", "check", "check"]
    assert "- wordy" in bench.prompt("check", 0) and "- placed" not in bench.prompt("check", 0)
    bench.answers["check"] = {"enough": True, "queries": ["old mill 3"]}
    assert len(bench.recall("alpha").items) == 2 and bench.purposes()[-2:] == ["plan", "check"]
    bench.answers["plan"] = "no plan"
    assert len(bench.recall("alpha").items) == 1  # the observation alone


def test_notes_with_pronouns_or_relative_times_are_counted() -> None:
    bench = Bench({**NAME, "window": 1}, {"compress": written("It is open now.", "The mill opens at 09:00.")})
    bench.step("s")
    assert bench.memory.metrics()["vague"] == 1


def test_parameters_out_of_range_are_refused() -> None:
    for params in ({"window": 0}, {"cluster": 1}, {"overlap": -1}):
        with pytest.raises(SpecError):
            Bench({"name": "simplemem", **params})


def test_simplemem_recalls_what_a_short_window_has_lost() -> None:
    memory = {"name": "simplemem", "preset": "rl", "window": 4}
    keep = {"compress": lambda request: json.dumps(written(*notes(request)))}
    assert not succeeds({"name": "base", "window": 5})
    assert succeeds(memory, curate=keep) and succeeds(memory, curate=keep, scope="run")


def test_enough_needs_no_further_queries() -> None:
    bench = Bench({**NAME, "plan": True}, {"plan": {"queries": ["mill"]}, "check": {"enough": True}})
    bench.memory.entries.put(Entry(0, "The mill is closed.", Time(0, 0, 0), {"keywords": [], "names": [], "topic": ""}))
    assert "The mill is closed." in bench.shown("a mill") and not bench.problems()
