"""Updates that start above the frozen layers: the same log-probabilities and gradients as from the first layer on."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from agentspec.llm.base import Request, assistant, user
from agentspec.llm.local import LocalLLM
from agentspec.records.log import RunLog
from agentspec.types import CallTag, Sampling
from tests.tiny import tiny_model, tiny_tokenizer
from tests.trainers.test_tree import forked_rows, gradients
from trainers.forward import frozen_output, rows_logprobs
from trainers.frozen import frozen_layers, layer_above
from trainers.sequences import Row, TokenSequence
from trainers.tree.model import enable_tree

LAYERS = 4


def upper_lora(packing: str, layers: tuple[int, ...] = (2, 3), **config: Any) -> Any:
    from peft import LoraConfig, get_peft_model

    model = tiny_model(tiny_tokenizer(), num_hidden_layers=LAYERS, **config)
    targets = ["q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj"]
    lora = LoraConfig(r=4, target_modules=targets, layers_to_transform=list(layers), init_lora_weights=False)
    policy = get_peft_model(model, lora)
    if packing == "tree":
        enable_tree(policy)
    return policy


@pytest.mark.parametrize("config", [{}, {"use_sliding_window": True, "sliding_window": 9, "max_window_layers": 0}])
@pytest.mark.parametrize(("packing", "budget"), [("tree", 0), ("tree", 40), ("padded", 0), ("padded", 60)])
def test_gradients_are_those_from_the_first_layer_on(packing: Any, budget: int, config: dict[str, Any]) -> None:
    model, rows = upper_lora(packing, **config), forked_rows(0)
    how: dict[str, Any] = {"packing": packing, "tokens_per_forward": budget}
    whole, whole_grads = gradients(model, rows, **how)
    layers = frozen_layers(model)
    assert len(layers) == 2
    output = frozen_output(model, layers, rows, **how)
    started, started_grads = gradients(model, rows, frozen=output, **how)
    assert len(whole_grads) == 2 * 2 * 7
    if how == {"packing": "tree", "tokens_per_forward": 0}:  # one forward has the shape of the other
        assert torch.equal(whole, started) and all(map(torch.equal, whole_grads, started_grads))
    assert torch.allclose(whole, started, atol=1e-6)
    for a, b in zip(whole_grads, started_grads, strict=True):
        assert float((a - b).norm()) <= 1e-5 * float(a.norm())


def test_micro_batches_start_from_what_the_whole_round_gave() -> None:
    model, rows = upper_lora("tree"), forked_rows(1)
    output = frozen_output(model, frozen_layers(model), rows, packing="tree")
    assert output is not None
    for part in (rows[:3], rows[3:]):
        whole, whole_grads = gradients(model, part, packing="tree")
        started, started_grads = gradients(model, part, packing="tree", frozen=output)
        assert torch.allclose(whole, started, atol=1e-6)
        for a, b in zip(whole_grads, started_grads, strict=True):
            assert float((a - b).norm()) <= 1e-5 * float(a.norm())


def test_the_frozen_layers_are_not_run_again() -> None:
    model, rows = upper_lora("tree"), forked_rows(2)
    layers, runs = frozen_layers(model), []
    output = frozen_output(model, layers, rows, packing="tree")
    for layer in model.get_base_model().model.layers:
        layer.input_layernorm.register_forward_hook(lambda *_: runs.append(1))
    rows_logprobs(model, rows, packing="tree", frozen=output)
    assert len(runs) == LAYERS - 2
    rows_logprobs(model, [*rows, Row(extended(rows[0]), 1.0, 9)], packing="tree", frozen=output)  # a row that is new
    assert len(runs) == LAYERS - 2 + LAYERS


def extended(row: Row) -> TokenSequence:
    sequence = TokenSequence()
    sequence.extend_context([*row.sequence.tokens, 5, 6, 7])
    sequence.mask[-1] = 1
    return sequence


def test_what_does_not_fit_is_computed_from_the_first_layer() -> None:
    model, rows = upper_lora("tree"), forked_rows(3)
    whole, grads = gradients(model, rows, packing="tree", tokens_per_forward=40)
    layers = frozen_layers(model)
    # 64 numbers of 4 bytes per token: room for 30 of the rows' 71 tokens or so.
    output = frozen_output(model, layers, rows, packing="tree", tokens_per_forward=40, limit=30 * 64 * 4)
    assert output is not None and 0 < len(output.states) <= 30
    some, some_grads = gradients(model, rows, packing="tree", tokens_per_forward=40, frozen=output)
    assert torch.allclose(whole, some, atol=1e-6)
    for a, b in zip(grads, some_grads, strict=True):
        assert float((a - b).norm()) <= 1e-5 * float(a.norm())
    assert frozen_output(model, layers, rows, packing="tree", limit=0) is None


def test_nothing_is_frozen_where_lower_weights_change() -> None:
    assert frozen_layers(upper_lora("tree", layers=(0, 3))) == []
    assert len(frozen_layers(upper_lora("tree", layers=(1,)))) == 1
    whole = tiny_model(tiny_tokenizer())
    assert frozen_layers(whole) == []  # all of it is trained
    assert frozen_layers(whole.requires_grad_(False)) == []  # nothing is
    model = upper_lora("tree")
    model.get_base_model().get_input_embeddings().weight.requires_grad_(True)
    assert frozen_layers(model) == []
    second = upper_lora("tree")
    from peft import LoraConfig

    second.add_adapter("other", LoraConfig(r=2, target_modules=["q_proj"], layers_to_transform=[0]))
    assert frozen_layers(second) == []  # an adapter that is not active now may be


def test_a_layer_that_reads_more_than_its_input_is_not_passed_over() -> None:
    model = upper_lora("tree")
    first, last = (model.get_base_model().model.layers[i] for i in (0, LAYERS - 1))
    seen: list[torch.Tensor] = []
    first.register_forward_hook(lambda module, inputs, output: seen.append(output))
    last.register_forward_hook(lambda module, inputs, output: output + (seen.pop() if seen else 0))
    assert frozen_layers(model) == []


def test_gradient_checkpointing_keeps_the_gradients() -> None:
    model, rows = upper_lora("tree"), forked_rows(4)
    _, plain = gradients(model, rows, packing="tree")
    output = frozen_output(model, frozen_layers(model), rows, packing="tree")
    for reentrant in (False, True):
        model.enable_input_require_grads()
        model.gradient_checkpointing_enable({"use_reentrant": reentrant})
        model.train()
        _, again = gradients(model, rows, packing="tree", frozen=output)
        for a, b in zip(plain, again, strict=True):
            assert float((a - b).norm()) <= 1e-5 * float(a.norm())


def test_rollouts_leave_what_an_update_starts_from() -> None:
    tokenizer = tiny_tokenizer()
    model = upper_lora("tree")
    layers = frozen_layers(model)
    llm = LocalLLM(model, tokenizer, name="policy", max_context=512)
    recorder = llm.record_states(layer_above(model, layers))

    async def episode(number: int) -> list[Row]:
        """Two turns, the second with the first as its beginning; two samples of each prompt, of which the second
        leads nowhere.
        """
        rows, messages = [], [user(f"Where to now, courier {number}?")]
        for turn in range(2):
            tag = CallTag("reasoning.direct", "act", f"e{number}", turn)
            request = Request(tuple(messages), Sampling(max_tokens=6, n=2), tag, seed=number, id=turn)
            call = await llm.generate(request)
            for completion in call.completions:
                sequence = TokenSequence()
                sequence.extend_context(list(call.prompt_ids))
                sequence.extend_sampled(call, completion)
                rows.append(Row(sequence, 1.0, number))
            messages = [*messages, assistant("north"), user("And now?")]
        return rows

    async def play() -> list[Row]:
        return [row for rows in await asyncio.gather(*(episode(n) for n in range(3))) for row in rows]

    rows = asyncio.run(play())
    found = [recorder.find(r.sequence.tokens[:-1]) for r in rows]
    assert all(f is not None and len(f) == len(r.sequence) - 1 for f, r in zip(found, rows, strict=True))
    computed = frozen_output(model, layers, rows, packing="tree")
    left = frozen_output(model, layers, rows, packing="tree", recorded=recorder.find)
    assert computed is not None and left is not None and len(rows) == 12
    assert torch.allclose(computed.states, left.states, atol=1e-5)
    _, a = gradients(model, rows, packing="tree")
    logps, b = gradients(model, rows, packing="tree", frozen=left)
    sampled = torch.cat([torch.tensor(r.sequence.logprobs)[torch.tensor(r.sequence.mask) > 0] for r in rows])
    assert torch.allclose(logps[logps != 0], sampled, atol=1e-5)  # invariant 1
    for x, y in zip(a, b, strict=True):
        assert float((x - y).norm()) <= 1e-5 * float(x.norm())
    recorder.clear()
    assert recorder.find(rows[0].sequence.tokens[:-1]) is None


@pytest.mark.parametrize("changes", [{}, {"beta": 0.1}, {"num_iterations": 2}, {"packing": "padded"}], ids=str)
def test_a_run_is_the_one_that_starts_from_the_first_layer(tmp_path: Any, monkeypatch: Any, changes: Any) -> None:
    import trainers.grpo
    from tests.trainers import played

    monkeypatch.setattr(played, "tiny_model", lambda tokenizer: upper_lora("padded"))
    updates = []
    for name in ("frozen", "whole"):
        if name == "whole":
            monkeypatch.setattr(trainers.grpo, "frozen_layers", lambda model: [])
        run = played.toy_trainer(tmp_path / name, max_steps=1, rewards={"env": 1.0}, **changes)
        assert len(run._frozen) == (2 if name == "frozen" else 0)
        run.train()
        # Only a round that is one update starts from what its rollouts left.
        assert (run._recorder is not None) == (name == "frozen" and "num_iterations" not in changes)
        assert (run._below is not None) == (name == "frozen")
        updates += RunLog(tmp_path / name).read("metrics.jsonl")
    frozen, whole = updates
    assert whole["grad_norm"] > 0
    for figure in ("grad_norm", "loss", "entropy"):
        assert frozen[figure] == pytest.approx(whole[figure], rel=1e-5, abs=1e-6)
