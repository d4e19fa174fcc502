"""Invariant 2: tree-packed log-probabilities and gradients equal the padded, row-by-row ones."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from transformers import BloomConfig, BloomForCausalLM

pytest.importorskip("trl")

from agentspec.registry import SpecError
from tests.tiny import tiny_model, tiny_tokenizer
from trainers.forward import rows_logprobs
from trainers.sequences import Row, TokenSequence
from trainers.tree.model import enable_tree
from trainers.tree.trie import build_tree


def test_a_fork_is_stored_once() -> None:
    tree = build_tree([[1, 2, 3, 4], [1, 2, 5], [1, 2]])
    # Unique tokens: 1 2 | 3 4 | 5.
    assert tree.tokens == [1, 2, 3, 4, 5]
    assert tree.positions == [0, 1, 2, 3, 2]
    assert tree.places == [[0, 1, 2, 3], [0, 1, 4], [0, 1]]
    assert [n.path for n in tree.nodes] == [(), (0,), (0,)]


def test_long_runs_become_chains() -> None:
    tree = build_tree([list(range(10))], node_tokens=4)
    assert [(n.start, n.end, n.path) for n in tree.nodes] == [(0, 4, ()), (4, 8, (0,)), (8, 10, (0, 1))]


@given(st.lists(st.lists(st.integers(0, 2), min_size=1, max_size=8), min_size=1, max_size=8), st.integers(1, 4))
def test_every_sequence_can_be_read_back(sequences: list[list[int]], node_tokens: int) -> None:
    tree = build_tree(sequences, node_tokens)
    assert [[tree.tokens[i] for i in places] for places in tree.places] == sequences
    assert [[tree.positions[i] for i in places] for places in tree.places] == [list(range(len(s))) for s in sequences]
    prefixes = {tuple(s[: n + 1]) for s in sequences for n in range(len(s))}
    assert len(tree.tokens) == len(prefixes)  # each distinct prefix costs one token
    for node in tree.nodes:
        past = [p for a in node.path for p in tree.positions[tree.nodes[a].start : tree.nodes[a].end]]
        assert past == list(range(tree.positions[node.start]))


def forked_rows(seed: int, rows: int = 7, prefix: int = 20) -> list[Row]:
    """Rows that share prefixes of different lengths; some tokens trained by several rows, some constrained."""
    g = torch.Generator().manual_seed(seed)

    def draw(n: int) -> list[int]:
        return torch.randint(0, 250, (n,), generator=g).tolist()

    trunk, built = draw(prefix), []
    for r in range(rows):
        tokens = trunk[: 4 + 3 * r] + draw(3 + r)
        sequence = TokenSequence()
        sequence.extend_context(tokens)
        for p in range(2, len(tokens)):
            sequence.mask[p] = int(torch.rand((), generator=g) < 0.5)
            sequence.temperatures[p] = 0.5 + float(torch.rand((), generator=g))
            if sequence.mask[p] and torch.rand((), generator=g) < 0.3:
                sequence.allowed[p] = tuple(sorted({tokens[p], 3, 9, 11}))
        built.append(Row(sequence, 1.0, r))
    return built


def gradients(model: Any, rows: list[Row], **how: Any) -> tuple[torch.Tensor, list[torch.Tensor]]:
    model.zero_grad()
    logps, _ = rows_logprobs(model, rows, **how)
    weights = torch.linspace(-1, 1, logps.numel()).view_as(logps)
    (logps * weights).sum().backward()
    return logps.detach(), [p.grad.clone() for p in model.parameters() if p.grad is not None]


@pytest.mark.parametrize("config", [{}, {"use_sliding_window": True, "sliding_window": 9, "max_window_layers": 0}])
@pytest.mark.parametrize("budget", [0, 40])
def test_tree_equals_padded(config: dict[str, Any], budget: int) -> None:
    model = tiny_model(tiny_tokenizer(), **config)
    rows = forked_rows(0)
    padded, padded_grads = gradients(model, rows, packing="padded")
    enable_tree(model)
    tree, tree_grads = gradients(model, rows, packing="tree", tokens_per_forward=budget)
    assert torch.allclose(padded, tree, atol=2e-6)
    assert len(padded_grads) == len(tree_grads)
    for a, b in zip(padded_grads, tree_grads, strict=True):
        assert torch.allclose(a, b, atol=1e-5 * float(a.abs().max() + 1)), (a - b).abs().max()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_tree_equals_padded_on_random_forests(seed: int) -> None:
    model = tiny_model(tiny_tokenizer())
    rows = forked_rows(seed, rows=5, prefix=30) + forked_rows(seed + 1, rows=3)
    padded, _ = rows_logprobs(model, rows)
    enable_tree(model)
    tree, _ = rows_logprobs(model, rows, packing="tree")
    assert torch.allclose(padded, tree, atol=2e-6)


def test_lora_and_gradient_checkpointing() -> None:
    from peft import LoraConfig, get_peft_model

    model = tiny_model(tiny_tokenizer())
    lora = get_peft_model(model, LoraConfig(r=4, target_modules="all-linear", init_lora_weights=False))
    rows = forked_rows(3)
    padded, padded_grads = gradients(lora, rows, packing="padded")
    enable_tree(lora)
    tree, tree_grads = gradients(lora, rows, packing="tree")
    lora.enable_input_require_grads()
    lora.gradient_checkpointing_enable({"use_reentrant": False})
    lora.train()
    again, again_grads = gradients(lora, rows, packing="tree")
    for values, grads in ((tree, tree_grads), (again, again_grads)):
        assert torch.allclose(padded, values, atol=2e-6)
        for a, b in zip(padded_grads, grads, strict=True):
            assert torch.allclose(a, b, atol=1e-5 * float(a.abs().max() + 1))


def test_the_ordinary_forward_is_unchanged() -> None:
    model = tiny_model(tiny_tokenizer())
    ids = torch.tensor([[1, 2, 3, 4, 0], [5, 6, 7, 8, 9]])
    mask = torch.tensor([[1, 1, 1, 1, 0], [1, 1, 1, 1, 1]])
    before = model(input_ids=ids, attention_mask=mask).logits
    enable_tree(model)
    enable_tree(model)
    after = model(input_ids=ids, attention_mask=mask).logits
    assert torch.allclose(before[0, :4], after[0, :4]) and torch.allclose(before[1], after[1])
    assert model.generate(ids[1:], max_new_tokens=3, do_sample=False).shape == (1, 8)


def test_an_architecture_that_cannot_run_packed_is_refused_with_what_to_do() -> None:
    config = BloomConfig(vocab_size=64, hidden_size=16, n_layer=1, n_head=2)  # positions by ALiBi, from the mask
    with pytest.raises(SpecError, match=r"cannot run BloomForCausalLM .* set `packing: padded`"):
        enable_tree(BloomForCausalLM(config))
