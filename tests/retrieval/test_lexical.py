"""BM25 search: ranking, hostile queries, replacement, state."""

from __future__ import annotations

import re

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


@given(
    st.lists(st.text("abcde é\u0301_ßK", max_size=24), max_size=12), st.text("abcde é\u0301ßk", max_size=30), st.data()
)
def test_leaving_out_frequent_words_changes_no_order(texts: list[str], query: str, data: st.DataObject):
    made = index(*texts)
    for key in data.draw(st.lists(st.integers(0, 12), max_size=4)):
        if data.draw(st.booleans()):
            made.put(key, data.draw(st.text("abc d", max_size=9)))
        else:
            made.remove(key)
    words = list(dict.fromkeys(w.casefold() for w in re.findall(r"[^\W_]+", query)))
    if not words:
        return
    everything = made._ranked(words, 99, None)  # with every word
    assert len(made) == made._db.execute("SELECT count(*) FROM documents").fetchone()[0]
    for k in (1, 3, 99):
        found = made.search(query, k)
        assert [s for _, s in found] == pytest.approx([s for _, s in everything[:k]], abs=1e-4)
        assert all(dict(everything)[key] == pytest.approx(score, abs=1e-4) for key, score in found)


def test_frequent_words_are_left_out_unless_they_are_needed():
    made = index(*(f"the battery is {n}" for n in range(8)), "the order is late", "the Order again")
    assert made.search("the order is", 2) == made.search("order", 2)
    assert len(made.search("the order is", 5)) == 5  # two hold "order"; the others are found by the rest
    assert len(made.search("the", 3)) == 3
    other = Lexical()
    other.deserialize(made.serialize())
    assert other.search("the order is", 5) == made.search("the order is", 5) and len(other) == 10
