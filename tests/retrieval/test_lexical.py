"""BM25 search: ranking, hostile queries, replacement; SQLite's own scores as the oracle."""

from __future__ import annotations

import sqlite3

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.retrieval import Lexical
from agentspec.retrieval.lexical import _tokens, _words


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


WORDS = st.text("abcde é\u0301_ßKİ1.", max_size=24)


@given(st.lists(WORDS, max_size=12), WORDS, st.data())
def test_scores_are_those_of_fts5(texts: list[str], query: str, data: st.DataObject):
    """The oracle is SQLite: its tokenizer, its `bm25()`, its order."""
    made, kept = index(*texts), dict(enumerate(texts))
    for key in data.draw(st.lists(st.integers(0, 30), max_size=40)):
        if data.draw(st.booleans()):
            kept[key] = data.draw(WORDS)
            made.put(key, kept[key])
        else:
            made.remove(key)
            kept.pop(key, None)
    assert len(made) == len(kept)
    db = sqlite3.connect(":memory:")
    db.execute("CREATE VIRTUAL TABLE documents USING fts5(text, tokenize='porter unicode61')")
    folded = [(key, " ".join(_words(text))) for key, text in kept.items()]  # capitals and accents are ours
    db.executemany("INSERT INTO documents(rowid, text) VALUES (?, ?)", folded)
    stems = list(dict.fromkeys(_tokens(query)))
    # Every stem once, as it stands: SQLite would stem it once more.
    match = " OR ".join(f'"{word}"' for word in forms(query, stems))
    sql = "SELECT rowid, -rank FROM documents WHERE documents MATCH ? ORDER BY rank, rowid"
    everything = db.execute(sql, (match,)).fetchall() if stems else []
    assert made._ranked([w for w in stems if w in made._words], 99, None) == [
        (key, pytest.approx(score, rel=1e-9)) for key, score in everything
    ]
    for k in (1, 3, 99):  # with the words left out that say nothing
        found = made.search(query, k)
        assert [s for _, s in found] == pytest.approx([s for _, s in everything[:k]], abs=1e-4)
        assert all(dict(everything)[key] == pytest.approx(score, abs=1e-4) for key, score in found)


def forms(query: str, stems: list[str]) -> list[str]:
    """One form of each stem, as a query has it."""
    return [next(w for w in _words(query) if stem in _tokens(w)) for stem in stems]


def test_frequent_words_are_left_out_unless_they_are_needed():
    made = index(*(f"the battery is {n}" for n in range(8)), "the order is late", "the Order again")
    assert made.search("the order is", 2) == made.search("order", 2)
    assert len(made.search("the order is", 5)) == 5  # two hold "order"; the others are found by the rest
    assert len(made.search("the", 3)) == 3


def test_places_of_removed_documents_are_given_back():
    made = index(*(f"order {n}" for n in range(50)))
    for key in range(45):
        made.remove(key)
    assert len(made._keys) <= 2 * len(made) + 16
    assert [k for k, _ in made.search("order 47", 2)] == [47, 45]
