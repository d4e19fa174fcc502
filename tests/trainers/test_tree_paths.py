"""Tree attention by torch's kernel for CPUs has the values and gradients of dense attention with its mask."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tiny import tiny_model, tiny_tokenizer
from tests.trainers.test_tree_flex import SEQUENCES, ends
from trainers.tree.flex import sees
from trainers.tree.model import Wanted, enable_tree, packed_inputs
from trainers.tree.paths import knows, path_attention
from trainers.tree.trie import Tree, build_tree

HEADS, KV_HEADS, SIZE = 6, 3, 8


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def dense(tree: Tree, q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, window: int) -> torch.Tensor:
    """softmax(0.3 q k^T) v over what each token sees, written out: (1, N, heads, size)."""
    i, j = torch.arange(len(tree.tokens))[:, None], torch.arange(len(tree.tokens))[None]
    seen = sees(torch.tensor(ends(tree)), torch.tensor(tree.positions), window)(0, 0, i, j)
    k, v = (x.repeat_interleave(q.shape[1] // x.shape[1], 1) for x in (k, v))
    return ((0.3 * q @ k.transpose(2, 3)).masked_fill(~seen, -torch.inf).softmax(-1) @ v).transpose(1, 2)


def drawn(count: int) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(count)
    shapes = [(1, heads, count, SIZE) for heads in (HEADS, KV_HEADS, KV_HEADS)]
    return [torch.randn(shape, generator=g, dtype=torch.float64, requires_grad=True) for shape in shapes]


@settings(deadline=None, max_examples=60)
@given(SEQUENCES, st.sampled_from([1, 3, 100]), st.integers(0, 4), st.integers(1, 4), st.data())
def test_values_and_gradients_are_those_of_dense_attention(
    sequences: list[list[int]], node_tokens: int, window: int, threads: int, data: st.DataObject
) -> None:
    torch.set_num_threads(threads)
    tree = build_tree(sequences, node_tokens)
    count = len(tree.tokens)
    asked = data.draw(st.none() | st.sets(st.integers(0, count - 1), min_size=1))
    places = None if asked is None else torch.tensor(sorted(asked))
    inputs = drawn(count)
    expected, got = dense(tree, *inputs, window), path_attention(*inputs, tree, 0.3, window, places)
    if places is not None:
        kept = torch.zeros(count, 1, 1, dtype=torch.float64)
        kept[places] = 1.0
        expected = expected * kept  # zeros elsewhere
    assert torch.allclose(got, expected, atol=1e-12)
    weights = torch.randn(expected.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    of_expected, of_got = (torch.autograd.grad((x * weights).sum(), inputs) for x in (expected, got))
    for name, one, other in zip("qkv", of_got, of_expected, strict=True):
        assert torch.allclose(one, other, atol=1e-12), name


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_long_nodes_whose_queries_are_shared_out(threads: int) -> None:
    """Nodes of 128 tokens and rests of them, with branches that stand apart from what they continue."""
    torch.set_num_threads(threads)
    shared = list(range(150))
    tree = build_tree([[*shared, *range(900, 1040)], [*shared, *range(500, 590)], [*shared[:40], 7, 8]])
    assert max(tree.lengths) == 128 and any(len(spans) > 1 for spans in tree.spans)
    inputs = drawn(len(tree.tokens))
    expected, got = dense(tree, *inputs, 0), path_attention(*inputs, tree, 0.3, 0)
    assert torch.allclose(got, expected, atol=1e-12)
    of_expected, of_got = (torch.autograd.grad(x.square().sum(), inputs) for x in (expected, got))
    for one, other in zip(of_got, of_expected, strict=True):
        assert torch.allclose(one, other, atol=1e-11)


@given(SEQUENCES, st.integers(1, 4))
def test_spans_are_the_places_of_a_path(sequences: list[list[int]], node_tokens: int) -> None:
    tree = build_tree(sequences, node_tokens)
    for node, spans in zip(tree.nodes, tree.spans, strict=True):
        path = [tree.nodes[a] for a in node.path] + [node]
        assert [p for s, e in spans for p in range(s, e)] == [p for n in path for p in range(n.start, n.end)]
        assert all(e < s for (_, e), (s, _) in pairwise(spans))


def test_what_the_kernel_does_not_compute_is_left_to_others() -> None:
    q, v = torch.zeros(1, 2, 3, 8), torch.zeros(1, 2, 3, 4)
    assert knows(q, q, q)
    assert not knows(q, q, v) and not knows(q, q, q.bfloat16()) and not knows(*[q.to("meta")] * 3)


def test_values_that_do_not_lie_in_rows() -> None:
    tree = build_tree([[1, 2, 3, 4], [1, 2, 5]])
    inputs = [x.transpose(2, 3).contiguous().transpose(2, 3) for x in drawn(len(tree.tokens))]
    assert all(x.stride(-1) != 1 for x in inputs)
    assert torch.allclose(path_attention(*inputs, tree, 0.3, 0), dense(tree, *inputs, 0), atol=1e-12)


@pytest.mark.parametrize("checkpointing", [False, True])
def test_a_model_reads_its_last_layer_where_it_is_asked(checkpointing: bool) -> None:
    """Also under autocast, and a tree that was used once may be used again."""
    model = tiny_model(tiny_tokenizer()).train()
    enable_tree(model)
    if checkpointing:
        model.gradient_checkpointing_enable()
    pair = [[5, 6, 7, 8, 9], [5, 6, 11, 12]]
    tree = build_tree(pair)
    inputs = packed_inputs(tree, torch.device("cpu"))
    for row, places in ((0, (2, 4)), (1, (3,)), (0, (1,))):
        before = torch.tensor([tree.places[row][p - 1] for p in places])
        tokens = torch.tensor([pair[row][p] for p in places])
        wanted = Wanted(before, tokens, torch.ones(len(places)), (None,) * len(places))
        plain = model(input_ids=torch.tensor([pair[row]]), use_cache=False).logits[0].log_softmax(-1)
        expected = plain[[p - 1 for p in places], tokens]
        assert torch.allclose(model(**inputs, wanted=wanted).log_probs, expected, atol=1e-5)
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.allclose(model(**inputs, wanted=wanted).log_probs, expected, atol=0.3)
