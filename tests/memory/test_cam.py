"""CAM: affinity, overlapping clusters that grow with the graph, summaries of what changed, prune and grow."""

from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.memory.cam.hierarchy import Level, affinity
from agentspec.memory.parts.entries import Entry
from agentspec.registry import SpecError
from agentspec.retrieval import ego_split, label_propagation, replica_graph
from agentspec.services import Time
from tests.memory.bench import Bench, Rows
from tests.memory.recall_world import succeeds

NAME = {"name": "cam", "every": 1, "read": "embedding", "recent": 0, "most_summaries": 99}


def test_affinity_is_likeness_and_nearness_in_order() -> None:
    # 0.6 * 0.5 + 0.4 * exp(-1/2) = 0.3 + 0.4 * 0.60653: below 0.6, no link.
    assert affinity(0.5, 1) == pytest.approx(0.54261, abs=1e-5)
    assert affinity(1.0, 0) == pytest.approx(1.0) and affinity(1.0, 9) == pytest.approx(0.6)


def level_of(*edges: tuple[int, int]) -> Level:
    """A level to which the edges were added one by one."""
    level = Level()
    for a, b in edges:
        level.graph.connect(a, b)
        level.touch([a, b])
    return level


def test_the_centre_of_a_bow_tie_belongs_to_two_clusters() -> None:
    level = level_of((0, 1), (0, 2), (1, 2), (2, 3), (2, 4), (3, 4))
    assert level.replicas[2] == [[0, 1], [3, 4]]
    assert sorted(sorted(c) for c in level.clusters().values()) == [[0, 1, 2], [2, 3, 4]]


small_graphs = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)).filter(lambda e: e[0] != e[1]), max_size=25)


@given(small_graphs)
def test_growing_and_building_at_once_give_the_same_replicas_and_clusters_that_hold(
    edges: list[tuple[int, int]],
) -> None:
    grown, whole = level_of(*edges), Level()
    for a, b in edges:
        whole.graph.connect(a, b)
    whole.touch(list(whole.graph))
    assert grown.replicas == whole.replicas == ego_split(whole.graph)
    # Of both, labels would not change any more: every replica has one of the labels most frequent around it.
    for level in (grown, whole):
        split = replica_graph(level.graph, level.replicas)
        assert label_propagation(split, start=level.labels) == level.labels


@given(small_graphs, st.lists(st.integers(0, 9), unique=True, max_size=5))
def test_nodes_that_go_leave_what_was_never_linked_to_them(edges: list[tuple[int, int]], gone: list[int]) -> None:
    level = level_of(*edges)
    for node in gone:
        if node in level.graph:
            around = list(level.graph.neighbours(node))
            level.graph.remove(node)
            level.touch(around)
    assert level.replicas == ego_split(level.graph)
    assert set(level.labels) == {(n, i) for n, parts in level.replicas.items() for i in range(len(parts))}
    again = Level()
    again.load(level.state())
    assert again.state() == level.state()
    assert (again.replicas, list(again.labels.items())) == (level.replicas, list(level.labels.items()))
    split = replica_graph(level.graph, level.replicas)  # every cluster hangs together
    for label in set(level.labels.values()):
        assert len(split.components(r for r, other in level.labels.items() if other == label)) == 1


def test_a_cluster_that_falls_apart_becomes_two() -> None:
    level = level_of((0, 1), (1, 2), (2, 0), (2, 3), (3, 4), (4, 2))
    level.labels = dict.fromkeys(level.labels, 7)  # as if a label had spread everywhere, and its bridge gone since
    level.fresh = 8
    level.touch([2])
    assert sorted(sorted(c) for c in level.clusters().values()) == [[0, 1, 2], [2, 3, 4]]


def test_a_part_of_the_graph_that_is_not_touched_keeps_its_cluster() -> None:
    level = level_of((0, 1), (0, 2), (1, 2))
    before = level.clusters()
    for a, b in ((5, 6), (6, 7), (5, 7)):
        level.graph.connect(a, b)
        level.touch([a, b])
    assert {label: level.clusters()[label] for label in before} == before and len(level.clusters()) == 2


WORLD = {"mill": [1.0, 0.0, 0.0], "port": [0.0, 1.0, 0.0], "sum M": [0.9, 0.0, 0.43589], "sum P": [0.0, 0.9, 0.43589]}


def towns(*places: str, **more: object) -> Bench:
    """Steps at the mill and at the port; those at one place are linked, however far apart (0.6 * 1 = theta)."""
    said = lambda r: "sum M" if "mill" in r.messages[-1].text else "sum P"  # noqa: E731
    bench = Bench({**NAME, **more}, {"summarise": said}, embedder=Rows(WORLD), scope="run")
    for place in places:
        bench.step(f"at the {place}")
    return bench


def test_only_clusters_that_changed_are_summed_up() -> None:
    bench = towns("mill", "mill")
    assert bench.purposes() == ["summarise"] and "sum M" in bench.shown("mill")
    bench.step("at the port")
    assert bench.purposes() == ["summarise"]  # alone
    bench.step("at the port")
    assert bench.purposes() == ["summarise"] * 2 and "mill" not in bench.prompt("summarise").partition("Notes from")[2]
    bench.step("at the mill")
    assert bench.purposes() == ["summarise"] * 3  # three at the mill: the same summary, written anew
    assert bench.memory.metrics() == {"entries": 5, "summaries": 2, "links": 4, "clusters": 2, "evicted": 0}
    assert bench.prompt("summarise").count("at the mill") == 3


def test_summaries_are_nodes_of_the_level_above() -> None:
    bench = towns("mill", "mill", "port", "port")
    one, two = bench.memory.parents[0].values()
    assert list(bench.memory.levels[1].graph) == [one, two] and bench.memory.nodes[one].data["level"] == 1
    assert len(bench.memory.nodes[one].data["children"]) == 2 and bench.memory.nodes[one].time.step == 1
    assert not bench.memory.levels[1].clusters()  # neither overlap nor link: nothing to sum up further


def test_summaries_of_clusters_that_touch_are_linked_and_summed_up_in_turn() -> None:
    # At theta 0.2 neighbours in order are linked whatever they say (0.4 * exp(-1/2) = 0.243): one cluster of three.
    bench = towns("mill", "port", "mill", theta=0.2, every=3, levels=1)
    assert bench.memory.metrics()["clusters"] == 1 and bench.memory.metrics()["summaries"] == 1
    # Two clusters that share a node are linked above, and the pair is summed up in its turn.
    memory = Bench({**NAME}, {"summarise": "Both."}, embedder=Rows(WORLD)).memory
    for i in range(5):
        memory.nodes.put(Entry(100 + i, f"note {i}", Time(0, i, i), {"level": 0}))
    for a, b in ((0, 1), (0, 2), (1, 2), (2, 3), (2, 4), (3, 4)):
        memory.levels[0].graph.connect(100 + a, 100 + b)
    memory.levels[0].touch([100 + i for i in range(5)])
    for level in range(3):
        asyncio.run(memory._summarise(level, 99))
    assert (
        len(memory.parents[0]) == 2 and len(memory.parents[1]) == 1 and len(list(memory.levels[1].graph.edges())) == 1
    )


def test_a_summary_that_cannot_be_had_is_asked_for_again() -> None:
    bench = towns()
    bench.answers["summarise"] = ["", "sum M"]
    bench.step("at the mill")
    bench.step("at the mill")
    assert bench.memory.metrics()["summaries"] == 0 and bench.problems() == {"malformed": 1}
    bench.step("at the port")
    assert bench.memory.metrics()["summaries"] == 1


def test_a_round_makes_at_most_so_many_calls() -> None:
    bench = towns("mill", "mill", "port", "port", every=4, most_summaries=1)
    assert bench.purposes() == ["summarise"]
    for _ in range(4):
        bench.step("elsewhere, alone")
    assert bench.purposes().count("summarise") == 2


def test_the_oldest_steps_go_and_empty_clusters_with_them() -> None:
    bench = towns("mill", "mill", "port", "port", "port", "port", capacity=3)
    metrics = bench.memory.metrics()
    assert (metrics["entries"], metrics["evicted"], metrics["summaries"], metrics["clusters"]) == (3, 3, 1, 1)
    assert "sum M" not in bench.shown("mill") and "sum P" in bench.shown("port")
    bench.memory.restore(bench.memory.snapshot())
    bench.step("at the port")
    assert bench.memory.metrics()["entries"] == 3


def test_reading_prunes_and_grows() -> None:
    bench = towns("mill", "mill", "port", read="model", seeds=1, rounds=2)
    # The first candidate at "sum M" is the summary; picked, it leads to its children, one of which is shown next.
    bench.answers["select"] = {"useful": [0, 0, 7]}
    shown = bench.shown("sum M")
    assert [line.partition(" [")[0] for line in shown.splitlines()] == [
        "- sum M",
        "- WAIT() -> done; seen: at the mill",
    ]
    assert bench.purposes()[-2:] == ["select", "select"]
    assert "0. sum M [up to step 2]" in bench.prompt("select", 0) and "port" not in bench.prompt("select")
    bench.answers["select"] = {"useful": []}
    assert bench.shown("sum M") == "" and bench.purposes()[-1:] == ["select"]
    bench.answers["select"] = "?"
    assert "- sum M" in bench.shown("sum M")  # similarity decides


def test_what_is_left_grows_when_the_next_episode_begins() -> None:
    bench = towns("mill", "mill", every=3)
    bench.end()
    assert bench.asked == []
    assert "- sum M [up to episode 1, step 2]" in bench.shown("mill") and bench.purposes() == ["summarise"]


def test_parameters_out_of_range_are_refused() -> None:
    for params in ({"every": 0}, {"read": "aloud"}, {"levels": 0}):
        with pytest.raises(SpecError):
            Bench({"name": "cam", **params})


def test_cam_recalls_what_a_short_window_has_lost() -> None:
    memory = {"name": "cam", "preset": "rl", "every": 4}
    assert not succeeds({"name": "base", "window": 5})
    assert succeeds(memory) and succeeds(memory, scope="run")
