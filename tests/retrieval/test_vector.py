"""Exact cosine search: order, ties, replacement, removal, filters, state."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from agentspec.retrieval import VectorIndex


class Plane:
    """Two dimensions: a text "x y" is the direction (x, y). Counts what it embeds."""

    dim = 2

    def __init__(self) -> None:
        self.asked: list[str] = []

    def embed(self, texts: list[str]) -> np.ndarray:
        self.asked += texts
        rows = np.array([[float(v) for v in t.split()] for t in texts], dtype=np.float32).reshape(-1, 2)
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def index(*texts: str) -> VectorIndex:
    made = VectorIndex(Plane())
    for key, text in enumerate(texts):
        made.put(key, text)
    return made


def test_nearest_first_with_cosine_similarity():
    # cos((1,0), (1,0)) = 1; (1,1): 1/sqrt 2 = 0.7071; (0,1): 0
    found = index("0 1", "1 1", "1 0").search("1 0", 3)
    assert [key for key, _ in found] == [2, 1, 0]
    np.testing.assert_allclose([score for _, score in found], [1.0, 2**-0.5, 0.0], atol=1e-6)


def test_equal_scores_keep_the_order_of_insertion_at_the_cut():
    assert [key for key, _ in index("0 1", "2 0", "1 0", "3 0").search("1 0", 2)] == [1, 2]


def test_least_and_where_limit_what_is_found():
    made = index("1 0", "1 1", "0 1")
    assert [k for k, _ in made.search("1 0", 9, least=0.5)] == [0, 1]
    assert [k for k, _ in made.search("1 0", 1, where=lambda key: key != 0)] == [1]
    assert [k for k, _ in made.similar(0, 9)] == [1, 2]


def test_replaced_text_is_found_by_its_new_meaning():
    made = index("1 0", "0 1")
    made.search("1 0", 1)
    made.put(0, "0 2")
    assert [k for k, _ in made.search("0 1", 2)] == [0, 1]
    assert made.text(0) == "0 2"


def test_removal_keeps_the_others_and_unknown_keys_are_ignored():
    made = index("1 0", "1 1", "0 1")
    made.search("1 0", 1)
    made.remove(0)
    made.remove(77)
    made.put(5, "3 1")
    assert [k for k, _ in made.search("1 0", 9)] == [5, 1, 2]
    assert len(made) == 3 and 0 not in made


def test_state_holds_texts_and_restores_the_same_answers():
    made = index("1 0", "1 1", "0 1")
    other = VectorIndex(Plane())
    other.load(made.state())
    assert other.search("2 1", 3) == made.search("2 1", 3)
    assert made.state() == [[0, "1 0"], [1, "1 1"], [2, "0 1"]]


def test_texts_are_embedded_once_and_only_when_needed():
    made = index("1 0", "0 1")
    assert made.embedder.asked == []
    made.search("1 1", 1)
    made.search("1 1", 1)
    assert made.embedder.asked == ["1 0", "0 1", "1 1", "1 1"]


def test_an_empty_index_finds_nothing():
    assert VectorIndex(Plane()).search("1 0", 3) == []
    assert index("1 0").search("1 0", 0) == []


@given(st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)).filter(any), max_size=12), st.integers(1, 5))
def test_partial_sort_equals_a_full_stable_sort(points: list[tuple[int, int]], k: int):
    made = index(*(f"{x} {y}" for x, y in points))
    scores = made.scores("1 2")
    full = sorted(range(len(points)), key=lambda i: -scores[i])[:k]
    assert [key for key, _ in made.search("1 2", k)] == full
