"""The trie over choices: what is allowed where, what is forced, and that walks spell choices."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.llm.constrain import ChoiceTrie

END = 9


def test_prefix_choice_branches_at_its_end():
    # "go" = 1 2, "go north" = 1 2 3, "wait" = 4
    trie = ChoiceTrie([(1, 2), (1, 2, 3), (4,)], END)
    assert trie.allowed(0) == (1, 4)
    go = trie.advance(trie.advance(0, 1), 2)
    assert trie.allowed(go) == (3, END)
    assert trie.choice(go) == -1
    assert trie.choice(trie.advance(go, END)) == 0
    assert trie.walk((1, 2, END)) == ((1, 4), (2,), (3, END))
    assert trie.walk((4, END)) == ((1, 4), (END,))
    assert trie.longest == 4


def test_forced_runs_stop_at_branches_and_leaves():
    trie = ChoiceTrie([(1, 2, 3), (1, 2, 4, 5)], END)
    run, branch = trie.forced(0)
    assert run == (1, 2)
    assert trie.forced(branch) == ((), branch)
    run, leaf = trie.forced(trie.advance(branch, 4))
    assert run == (5, END)
    assert trie.choice(leaf) == 1


def test_single_choice_is_all_forced():
    run, leaf = ChoiceTrie([(1, 2)], END).forced(0)
    assert run == (1, 2, END)
    assert ChoiceTrie([(1, 2)], END).choice(leaf) == 0


def test_equal_choices_are_the_first():
    trie = ChoiceTrie([(1,), (1,)], END)
    _, leaf = trie.forced(0)
    assert trie.choice(leaf) == 0


def test_errors():
    with pytest.raises(ValueError, match="no choices"):
        ChoiceTrie([], END)
    with pytest.raises(ValueError, match="choice 1 contains the end-of-turn token 9"):
        ChoiceTrie([(1,), (2, END)], END)
    with pytest.raises(ValueError, match=r"token 5 is not allowed here; allowed: \(1,\)"):
        ChoiceTrie([(1,)], END).advance(0, 5)


@given(st.lists(st.lists(st.integers(0, 4), max_size=5).map(tuple), min_size=1, max_size=8, unique=True), st.data())
def test_every_walk_spells_a_choice(sequences, data):
    trie = ChoiceTrie(sequences, END)
    node, spelled = 0, []
    while trie.choice(node) < 0:
        token = data.draw(st.sampled_from(trie.allowed(node)))
        spelled.append(token)
        node = trie.advance(node, token)
    assert sequences[trie.choice(node)] == tuple(spelled[:-1])
    assert spelled[-1] == END
    assert len(spelled) <= trie.longest
