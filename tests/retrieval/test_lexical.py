"""BM25 search: ranking, hostile queries, replacement, state."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.retrieval import Lexical


def index(*texts: str) -> Lexical:
    made = Lexical()
    for key, text in enumerate(texts):
        made.put(key, text)
    return made


def test_a_rare_word_outranks_a_common_one():
    made = index("the battery is low", "the order is late", "the order is cold")
    assert [key for key, _ in made.search("battery order", 3)] == [0, 1, 2]
    assert all(score > 0 for _, score in made.search("battery", 3))


def test_word_forms_meet():
    assert [k for k, _ in index("charging at the station", "nothing").search("charge stations", 2)] == [0]


def test_replace_remove_and_filter():
    made = index("red key", "red door", "red ball")
    made.put(0, "blue key")
    made.remove(2)
    made.remove(99)
    assert [k for k, _ in made.search("red", 5)] == [1]
    assert made.search("red", 5, where=lambda key: key != 1) == []
    assert len(made) == 2


@given(st.text())
def test_no_query_is_read_as_syntax(query: str):
    made = index("red key", "blue door")
    assert len(made.search(query, 2)) <= 2


def test_syntax_of_fts_is_words():
    made = index("NEAR the NOT gate", "other")
    for query in (
        '"',
        "NOT",
        "text:gate",
        "gate*",
        "NEAR(gate 1)",
        "a AND",
        "(",
        "-gate",
        "'; DROP TABLE documents; --",
    ):
        made.search(query, 3)
    assert len(made) == 2
    assert made.search("", 3) == [] and made.search("?!", 3) == []


def test_serialize_is_exact():
    made = index("red key", "red door")
    other = Lexical()
    other.deserialize(made.serialize())
    assert other.search("red key", 2) == made.search("red key", 2)
    other.put(2, "red ball")
    assert len(made) == 2


def test_a_damaged_image_is_refused_and_the_index_stays():
    made = index("red key")
    with pytest.raises(ValueError, match="not a serialized lexical index"):
        made.deserialize(b"no database")
    assert [k for k, _ in made.search("red", 1)] == [0]
