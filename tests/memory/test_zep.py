"""Zep: facts in two kinds of time, contradicted and never deleted; entities; search along the graph; communities."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.embedding import HashEmbedder
from agentspec.memory.zep.temporal import TemporalGraph, holds
from agentspec.registry import SpecError
from agentspec.retrieval import Graph, label_propagation
from agentspec.services import Time
from agentspec.state import dump_state, load_state
from tests.memory.bench import Bench, observation
from tests.memory.recall_world import notes, succeeds

NAME = {"name": "zep", "every": 1, "repairs": 0, "recent": 0, "least": 0.0}


def facts(*given: tuple[str, str, str, str]) -> dict:
    names = ("subject", "relation", "object", "fact")
    return {"facts": [{**dict(zip(names, g, strict=True)), "since": None} for g in given]}


def results(*given: tuple[int, int | None, list[int]]) -> dict:
    return {"results": [{"fact": f, "same": s, "contradicts": c} for f, s, c in given]}


CLOSED, OPEN = ("door", "is", "", "The door is closed."), ("door", "is", "", "The door is open.")


def graph_of(*told: tuple[str, int, int]) -> TemporalGraph:
    """Facts about a door: text, since when, when told."""
    graph = TemporalGraph(HashEmbedder(), 100)
    graph.add_entity(0, "door")
    for i, (text, valid, at) in enumerate(told):
        graph.add_fact(i, text, Time(0, at, at), (0, "is", 0), valid)
    return graph


def at(graph: TemporalGraph, step: int) -> list[str]:
    return [e.text for e in graph.as_of(step)]


def test_what_is_contradicted_ends_where_the_other_begins_and_stays() -> None:
    graph = graph_of(("closed", 3, 3), ("open", 7, 8))
    graph.contradict(1, 0, now=8)
    assert (at(graph, 2), at(graph, 5), at(graph, 6), at(graph, 7), at(graph, 9)) == (
        [],
        ["closed"],
        ["closed"],
        ["open"],
        ["open"],
    )
    assert graph.facts[0].data["invalid"] == 7 and graph.facts[0].data["expired"] == 8 and len(graph.facts) == 2


def test_what_is_told_late_about_earlier_times_is_over_at_once() -> None:
    graph = graph_of(("open", 7, 7), ("closed", 3, 9))  # told at 9 that it was closed at 3
    graph.contradict(1, 0, now=9)
    assert at(graph, 5) == ["closed"] and at(graph, 9) == ["open"]
    assert graph.facts[1].data == {**graph.facts[1].data, "invalid": 7, "expired": 9}


def test_facts_of_times_that_do_not_overlap_do_not_contradict() -> None:
    graph = graph_of(("closed", 1, 1), ("open", 3, 3), ("closed again", 8, 8))
    graph.contradict(1, 0, now=3)  # closed: 1 to 3
    graph.contradict(2, 0, now=8)  # had ended before
    assert graph.facts[0].data["invalid"] == 3 and graph.facts[0].data["expired"] == 3
    assert at(graph, 9) == ["open", "closed again"]


@given(st.permutations([("a", 2), ("b", 5), ("c", 9)]))
def test_the_timeline_does_not_depend_on_the_order_of_telling(told: list[tuple[str, int]]) -> None:
    graph = graph_of(*((text, valid, 10 + i) for i, (text, valid) in enumerate(told)))
    for new in range(3):
        for old in range(new):
            graph.contradict(new, old, now=10 + new)
    ends = {e.text: e.data["invalid"] for e in graph.facts}
    assert ends["c"] is None and ends["b"] == 9 and ends["a"] in (5, 9)
    assert "b" in at(graph, 6) and at(graph, 9) == ["c"]


def test_a_contradiction_is_asked_about_and_done() -> None:
    bench = Bench(NAME, {"extract": [facts(CLOSED), facts(OPEN)], "resolve": results((0, None, [0]))})
    bench.step("a door")
    assert bench.purposes() == ["extract"]  # nothing to compare with
    bench.step("the door")
    assert bench.purposes() == ["extract", "extract", "resolve"]
    over = "- Not so any more: The door is closed. [from step 1 to step 2]"
    assert set(bench.shown("the door").splitlines()) == {"- The door is open. [since step 2]", over}
    assert bench.shown("was the door closed").splitlines()[0] == over  # by relevance, not by what holds
    bench.memory.past = False
    assert bench.shown("the door") == "- The door is open. [since step 2]"
    asked = bench.prompt("resolve")
    assert "0. The door is closed. [since step 1]" in asked and "0. The door is open. [since step 2]" in asked


def test_a_fact_told_again_is_mentioned_not_added() -> None:
    bench = Bench(NAME, {"extract": [facts(CLOSED), facts(CLOSED), facts(OPEN)], "resolve": results((0, 0, [0, 7]))})
    bench.step("a door")
    bench.step("the door")
    [fact] = bench.memory.graph.facts
    assert fact.data["mentions"] == [0, 1] and bench.purposes() == ["extract", "extract"]
    bench.step("the door")  # the model says that it is the same in other words, and a number that was not shown
    [fact] = bench.memory.graph.facts
    assert fact.text == "The door is closed." and fact.data["mentions"] == [0, 1, 2]


def test_since_is_a_step_of_the_episode_and_never_in_the_future() -> None:
    told = facts(("a", "is", "", "A."), ("b", "is", "", "B."), ("c", "is", "", "C."))
    for fact, since in zip(told["facts"], (2, 99, -4), strict=True):
        fact["since"] = since
    bench = Bench({**NAME, "every": 3}, {"extract": told})
    for _ in range(3):
        bench.step("s")
    assert [e.data["valid"] for e in bench.memory.graph.facts] == [1, 2, 0]


def test_alike_names_are_asked_about_and_other_numbers_are_other_things() -> None:
    first = facts(("restaurant 1", "is near", "old mill", "Restaurant 1 is near the old mill."))
    second = facts(("Restaurant 1", "is near", "the mill", "R."), ("restaurant 2", "is near", "old mill", "S."))
    bench = Bench(NAME, {"extract": [first, second], "same": {"same": [{"name": "the mill", "known": 0}]}})
    bench.answers["resolve"] = results()
    bench.step("one")
    bench.step("two")
    # "Restaurant 1" is known, "restaurant 2" is like nothing with a 2, "the mill" shares a word with "old mill".
    assert "New names:\n- the mill" in bench.prompt("same") and "restaurant 2" not in bench.prompt("same")
    graph = bench.memory.graph
    assert list(graph.names.values()) == ["restaurant 1", "old mill", "restaurant 2"]
    assert graph.entity("the mill") == graph.entity("Old Mill")


def test_without_an_answer_alike_names_are_different_things() -> None:
    first, second = facts(("old mill", "is", "", "A.")), facts(("the mill", "is", "", "B."))
    bench = Bench(NAME, {"extract": [first, second], "same": "?", "resolve": "?"})
    bench.step("one")
    bench.step("two")
    assert list(bench.memory.graph.names.values()) == ["old mill", "the mill"]
    assert bench.problems() == {"malformed": 1}


def chain() -> TemporalGraph:
    """a - b - c - d."""
    graph = TemporalGraph(HashEmbedder(), 100)
    for i, name in enumerate("abcd"):
        graph.add_entity(i, f"node {name}")
    for i in range(3):
        graph.add_fact(i, f"fact {i}", Time(0, i, i), (i, "leads to", i + 1), i)
    return graph


def test_the_graph_is_searched_so_many_hops_from_what_the_query_names() -> None:
    # From node a: fact 0 is one hop away, facts 1 and 2 two and three. Nothing is near in meaning or shares a word.
    for hops in (0, 1, 2, 3):
        found = chain().search("at node a", 9, least=0.99, hops=hops, past=True)
        assert [e.text for e, _ in found] == [f"fact {i}" for i in range(hops)]


def test_reciprocal_ranks_are_added() -> None:
    # "fact 1" is first in meaning and by words; along the graph from node a it is second: 1 + 1 + 1/2.
    found = chain().search("fact 1 seen at node a", 9, least=0.3, hops=3, past=True)
    assert found[0][0].text == "fact 1" and found[0][1] == pytest.approx(2.5)


def test_reranking_by_mentions_and_by_relevance_and_novelty() -> None:
    graph = chain()
    graph.mention(2, Time(0, 5, 5))
    assert [e.text for e, _ in graph.search("at node a", 2, least=0.99, hops=3, past=True, rerank="mentions")] == [
        "fact 2",
        "fact 0",
    ]
    found = graph.search("at node a", 3, least=0.99, hops=3, past=True, rerank="mmr")
    assert found[0][0].text == "fact 0" and len(found) == 3


def test_the_oldest_fact_goes_with_its_entities() -> None:
    graph = chain()
    graph.facts.capacity = 3
    graph.add_fact(3, "fact 3", Time(0, 9, 9), (3, "leads to", 1), 9)
    assert [e.text for e in graph.facts] == ["fact 1", "fact 2", "fact 3"]
    assert 0 not in graph.names and graph.entity("node a") is None and set(graph.graph) == {1, 2, 3}


@given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), max_size=25))
def test_label_propagation_ends_and_repeats(edges: list[tuple[int, int]]) -> None:
    assert label_propagation(Graph(edges)) == label_propagation(Graph(edges))
    # Two nodes with an edge end up alike, where labels that are swapped at once would be swapped for ever.
    assert len(set(label_propagation(Graph([("a", "b")])).values())) == 1


def test_communities_that_changed_are_summed_up_between_episodes() -> None:
    told = [facts(("mill", "near", "port", "The mill is near the port.")), facts(), facts(("sun", "is", "", "Sunny."))]
    bench = Bench(NAME, {"extract": told, "community": ["Mill and port.", "More."]}, scope="run")
    bench.step("one")
    assert "community" not in bench.purposes()
    bench.end()
    assert "- Of earlier episodes: Mill and port." in bench.shown("at the mill")
    assert "Mill and port." not in bench.shown("at the inn")  # names nothing of the community
    bench.step("two")
    bench.end()
    bench.shown("at the mill")
    assert bench.purposes().count("community") == 1  # nothing has changed
    assert "- The mill is near the port. [since episode 1, step 1]" in bench.prompt("community")
    assert bench.memory.metrics()["communities"] == 1


def test_a_fact_that_is_told_again_is_so_since_it_was_first() -> None:
    bench = Bench(NAME, {"extract": facts(CLOSED)}, scope="run")
    for number in range(3):
        for _ in range(2):
            bench.step("a door")
        since = "episode 1, step 1" if number else "step 1"
        assert f"The door is closed. [since {since}]" in bench.shown("door")
        bench.end()


def test_what_has_gone_leaves_the_graph_as_if_it_had_never_been() -> None:
    graph, kept = TemporalGraph(HashEmbedder(), 3), TemporalGraph(HashEmbedder(), 3)
    told = [(1, 2), (1, 3), (1, 2), (4, 5), (1, 3)]
    for i, (subject, target) in enumerate(told):
        for made in (graph, kept) if i >= 2 else (graph,):
            for id in (subject, target):
                if id not in made.names:
                    made.add_entity(id, f"thing {id}")
            made.add_fact(10 + i, f"fact {i}", Time(0, i, i), (subject, "near", target), i)
    assert sorted(graph.names) == sorted(kept.names) == [1, 2, 3, 4, 5]
    for id in kept.names:
        assert set(graph.graph.neighbours(id)) == set(kept.graph.neighbours(id))
        assert [e.id for e in graph.of((id,))] == [e.id for e in kept.of((id,))]
    graph.remove_fact(13)
    assert sorted(graph.names) == [1, 2, 3] and graph.entity("thing 4") is None and not graph.alike("thing 4", 3, 0.1)
    again = TemporalGraph(HashEmbedder(), 3)
    again.load(load_state(dump_state([graph.state()]))[0])
    assert again.state() == graph.state() and list(again.graph.edges()) == list(graph.graph.edges())


def test_facts_out_of_the_structured_state_need_no_call() -> None:
    bench = Bench({**NAME, "extraction": "state"}, {})
    time = Time(0, 0, 0)
    bench.memory._read_state({"door": {"state": "closed"}, "text": "x" * 99}, time)
    bench.memory._read_state({"door": {"state": "closed"}}, Time(0, 1, 1))
    bench.memory._read_state({"door": {"state": "open"}}, Time(0, 2, 2))
    found = [(e.text, e.data["valid"], e.data["invalid"]) for e in bench.memory.graph.facts]
    assert found == [("door: state is closed", 0, 2), ("door: state is open", 2, None)]
    assert holds(next(iter(bench.memory.graph.facts)), 1) and bench.asked == []
    assert bench.recall("door") == bench.recall("door") and observation("door").text == "door"


def test_an_extraction_that_cannot_be_read_leaves_the_steps_for_the_next_one() -> None:
    bench = Bench(NAME, {"extract": ["?", facts(CLOSED)]})
    bench.step("the first state")
    bench.step("the second state")
    assert "the first state" in bench.prompt("extract") and len(bench.memory.graph.facts) == 1


def test_parameters_out_of_range_are_refused() -> None:
    for params in ({"every": 0}, {"hops": -1}, {"rerank": "best"}, {"extraction": "none"}):
        with pytest.raises(SpecError):
            Bench({"name": "zep", **params})


def test_zep_recalls_what_a_short_window_has_lost() -> None:
    def extract(request) -> str:
        return json.dumps(facts(*((f"thing {i}", "is", "", note) for i, note in enumerate(notes(request)))))

    memory = {"name": "zep", "preset": "rl", "every": 4}
    keep = {"extract": extract, "same": '{"same": []}', "resolve": '{"results": []}', "community": "Town."}
    assert not succeeds({"name": "base", "window": 5})
    assert succeeds(memory, curate=keep) and succeeds(memory, curate=keep, scope="run")
