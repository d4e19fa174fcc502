"""The one-kernel form of tree attention: its mask is the tree, its values are those of attention node by node.

On a CPU FlexAttention runs uncompiled and forward only; on a GPU ``benchmarks.training_step`` compares gradients too.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.attention.flex_attention import flex_attention

from trainers.tree import attention as tree_module
from trainers.tree.attention import tree_attention
from trainers.tree.flex import sees, subtree_ends, usable
from trainers.tree.trie import Tree, build_tree

SEQUENCES = st.lists(st.lists(st.integers(0, 2), min_size=1, max_size=9), min_size=1, max_size=8)


def ends(tree: Tree) -> list[int]:
    return subtree_ends([n.start for n in tree.nodes], [n.end for n in tree.nodes], [n.path for n in tree.nodes])


@given(SEQUENCES, st.integers(1, 4), st.integers(0, 5))
def test_a_token_sees_its_own_path(sequences: list[list[int]], node_tokens: int, window: int) -> None:
    tree = build_tree(sequences, node_tokens)
    count = len(tree.tokens)
    i, j = torch.arange(count)[:, None], torch.arange(count)[None]
    got = sees(torch.tensor(ends(tree)), torch.tensor(tree.positions), window)(0, 0, i, j)
    # Along a sequence every token sees the tokens before it, at most `window` with itself, and nobody else's.
    expected = torch.zeros(count, count, dtype=torch.bool)
    for places in tree.places:
        for n, place in enumerate(places):
            expected[place, places[max(0, n + 1 - window) if window else 0 : n + 1]] = True
    assert torch.equal(got, expected)


@settings(deadline=None, max_examples=15)
@given(SEQUENCES, st.integers(0, 3))
def test_it_equals_attention_node_by_node(sequences: list[list[int]], window: int) -> None:
    tree = build_tree(sequences, 3)
    count = len(tree.tokens)
    g = torch.Generator().manual_seed(count)
    q, k, v = (torch.randn(1, heads, count, 16, generator=g) for heads in (4, 2, 2))
    module = torch.nn.Module()
    expected, _ = tree_attention(module, q, k, v, scaling=0.3, sliding_window=window, tree=tree)
    mask = tree.block_mask(window, torch.device("cpu"))
    got = flex_attention(q, k, v, block_mask=mask, scale=0.3, enable_gqa=True).transpose(1, 2)
    assert torch.allclose(got, expected, atol=1e-5)
    assert tree.block_mask(window, torch.device("cpu")) is mask  # built once for all layers


def test_a_cpu_goes_node_by_node() -> None:
    assert not usable(torch.device("cpu"), torch.float32)


def test_where_the_kernel_runs_it_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    tree = build_tree([[1, 2, 3], [1, 4]])
    q, k, v = (torch.randn(1, heads, 4, 8) for heads in (4, 2, 2))
    module = torch.nn.Module()
    expected, _ = tree_attention(module, q, k, v, tree=tree)

    def uncompiled(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, mask: object, scaling: object) -> torch.Tensor:
        return flex_attention(q, k, v, block_mask=mask, scale=scaling, enable_gqa=True)  # type: ignore[return-value]

    monkeypatch.setattr(tree_module, "usable", lambda *_: True)
    monkeypatch.setattr(tree_module, "flex_tree", uncompiled)
    got, _ = tree_attention(module, q, k, v, tree=tree)
    assert torch.allclose(got, expected, atol=1e-5)
