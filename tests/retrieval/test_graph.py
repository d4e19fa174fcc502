"""The graph kit against networkx, and what its algorithms promise."""

from __future__ import annotations

import networkx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.retrieval import Graph, ego_split, label_propagation, replica_graph

edges = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)).filter(lambda e: e[0] != e[1]), max_size=25)
BOW_TIE = [("a", "b"), ("a", "c"), ("b", "c"), ("c", "d"), ("c", "e"), ("d", "e")]


def oracle(pairs: list[tuple[int, int]]) -> networkx.Graph:
    made = networkx.Graph()
    made.add_edges_from(pairs)
    return made


@given(edges)
def test_components_are_those_of_networkx(pairs):
    ours = {frozenset(c) for c in Graph(pairs).components()}
    assert ours == {frozenset(c) for c in networkx.connected_components(oracle(pairs))}


@given(edges, st.integers(0, 9), st.integers(0, 4))
def test_neighbourhoods_are_those_of_networkx(pairs, start, hops):
    graph = Graph([*pairs, (start, 10)])
    expected = networkx.single_source_shortest_path_length(oracle([*pairs, (start, 10)]), start, cutoff=hops)
    assert graph.within([start], hops) == dict(expected)


@given(edges)
def test_components_of_a_subgraph(pairs):
    graph, keep = Graph(pairs), [0, 2, 4, 6, 8]
    ours = {frozenset(c) for c in graph.components(keep)}
    expected = networkx.connected_components(oracle(pairs).subgraph(keep))
    assert ours == {frozenset(c) for c in expected}


@given(edges)
def test_label_propagation_ends_in_a_stable_or_bounded_state_within_components(pairs):
    graph = Graph(pairs)
    labels = label_propagation(graph)
    assert set(labels) == set(graph)
    component = {node: i for i, nodes in enumerate(graph.components()) for node in nodes}
    by_label: dict[int, set[int]] = {}
    for node, label in labels.items():
        by_label.setdefault(label, set()).add(component[node])
    assert all(len(c) == 1 for c in by_label.values())
    assert label_propagation(Graph(pairs)) == labels


def test_two_nodes_agree_instead_of_swapping_for_ever():
    assert label_propagation(Graph([("A", "B"), ("B", "A")])) == {"A": 1, "B": 1}


def test_label_propagation_finds_two_cliques():
    left = [(a, b) for a in range(4) for b in range(a)]
    right = [(a + 10, b + 10) for a, b in left]
    labels = label_propagation(Graph([*left, *right, (0, 10)]))
    assert len({labels[n] for n in range(4)}) == 1
    assert len({labels[n + 10] for n in range(4)}) == 1
    assert labels[0] != labels[10]


def test_the_number_of_visits_is_bounded():
    labels = label_propagation(Graph([(0, 1), (1, 2), (2, 0)]), most_updates=1)
    assert sorted(labels.values()) == [1, 1, 2]  # node 0 took 1's label, the smallest of 1 and 2


def test_propagation_from_earlier_labels_touches_only_what_changed():
    graph = Graph([(0, 1), (2, 3)])
    labels = label_propagation(graph)
    graph.connect(3, 4)
    assert label_propagation(graph, start=labels, changed=[4]) == {**labels, 4: labels[3]}


def test_ego_splitting_gives_the_centre_of_a_bow_tie_two_replicas():
    graph = Graph(BOW_TIE)
    replicas = ego_split(graph)
    assert replicas["c"] == [["a", "b"], ["d", "e"]]
    split = replica_graph(graph, replicas)
    assert {frozenset(c) for c in split.components()} == {
        frozenset({("a", 0), ("b", 0), ("c", 0)}),
        frozenset({("d", 0), ("e", 0), ("c", 1)}),
    }


@given(edges)
def test_replicas_keep_every_edge_once(pairs):
    graph = Graph(pairs)
    split = replica_graph(graph, ego_split(graph))
    assert len(list(split.edges())) == len(list(graph.edges())) == oracle(pairs).number_of_edges()


def test_removal_and_state():
    graph = Graph([("a", "b"), ("b", "c")])
    graph.connect("b", "c", 0.25)
    other: Graph[str] = Graph()
    other.load(graph.state())
    graph.remove("b")
    graph.remove("zz")
    assert list(graph) == ["a", "c"] and list(graph.edges()) == []
    assert other.neighbours("b") == {"a": 1.0, "c": 0.25}
    with pytest.raises(KeyError):
        graph.neighbours("b")
