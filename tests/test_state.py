"""State as bytes: what is written once reads as what is written whole."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.memory.parts.entries import Entries, Entry
from agentspec.services import Time
from agentspec.state import Json, Record, dump_state, joined, keyed, load_state
from tests.memory.bench import Rows

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@dataclass(frozen=True)
class Note(Record):
    text: Any
    more: Any = None


@given(st.lists(st.tuples(values, values), max_size=5))
def test_records_are_written_as_their_rows(rows: list[tuple[Any, Any]]) -> None:
    notes = [Note(*row) for row in rows]
    whole = dump_state([[list(row) for row in rows], len(rows)])
    assert dump_state([joined(note.json for note in notes), len(rows)]) == whole
    pairs = dump_state([keyed(dict(enumerate(notes)))])
    assert load_state(pairs) == [[[key, list(row)] for key, row in enumerate(rows)]]


def test_a_record_is_written_once_and_its_replacement_anew() -> None:
    note = Note("a", [1])
    assert note.json is note.json and note.json.text == '["a",[1]]'
    assert replace(note, text="b").json.text == '["b",[1]]' and note == Note("a", [1])


def test_keys_must_be_strings_wherever_they_stand() -> None:
    for made in (lambda: Note({1: 2}).json, lambda: joined([[{"a": {2: 3}}]]), lambda: dump_state({"a": [{None: 1}]})):
        with pytest.raises(TypeError, match="keys must be strings"):
            made()
    with pytest.raises(TypeError, match="not JSON serializable"):  # parts stand in a list of their own
        dump_state([[Json("1")]])


@given(st.lists(st.tuples(st.integers(0, 9), st.sampled_from("ab"), st.integers(0, 5), st.booleans()), max_size=30))
def test_notes_are_forgotten_and_confirmed_as_a_plain_list_would(told: list[tuple[int, str, int, bool]]) -> None:
    """The oracle goes through all notes for what was written longest ago, and for one that says the same."""
    made, plain = Entries(Rows({"a": [1.0], "b": [0.5]}), 4), dict[int, Entry]()
    for id, text, total, confirm in told:
        time = Time(0, total, total)
        if confirm:
            same = next((e for e in plain.values() if e.text == text), None)
            assert made.confirm(text, time) == (same is not None)
            if same is not None:
                plain[same.id] = replace(same, time=time)
            continue
        made.put(Entry(id, text, time))
        plain[id] = Entry(id, text, time)
        if len(plain) > 4:
            del plain[min(plain.values(), key=lambda e: e.time.total).id]
        assert list(made) == list(plain.values())
    again = Entries(Rows({"a": [1.0], "b": [0.5]}), 4)
    again.load(load_state(dump_state([made.state()]))[0])
    assert list(again) == list(made) and again.state() == made.state()
