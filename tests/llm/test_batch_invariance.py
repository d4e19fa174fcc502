"""Batch invariance: what a token's logits are, to the last bit, depends on its context only.

The engine is tested, on whatever CPU the tests run, with several numbers of threads; that each measure it takes is
needed, or at least does no harm, by taking it away.
"""

from __future__ import annotations

import asyncio
import random
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, get_args

import pytest
import torch

from agentspec.llm.base import user
from agentspec.llm.batching import Batching
from agentspec.llm.local import LocalLLM, probe
from agentspec.llm.local.attention import Segment
from agentspec.llm.local.cache import Slot
from agentspec.llm.local.forward import PackedModel
from agentspec.llm.local.invariance import InvariantModules, elementwise
from agentspec.llm.models import BUNDLED
from tests.llm.helpers import needs_smollm2, request
from tests.llm.test_local import close, tiny
from tests.llm.test_local_batching import LENGTHS, episode, play
from tests.tiny import tiny_model, tiny_tokenizer


@contextmanager
def threads(count: int) -> Iterator[None]:
    """torch computes with so many threads inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def adapted(model: Any, rank: int = 16, **config: Any) -> Any:
    """The model with a LoRA adapter on all linear layers that changes what it says."""
    from peft import LoraConfig, get_peft_model

    torch.manual_seed(0)
    return get_peft_model(
        model, LoraConfig(r=rank, target_modules="all-linear", init_lora_weights=False, **config)
    ).eval()


def read(model: PackedModel, text: list[int], draw: random.Random, logits: int) -> torch.Tensor:
    """The last ``logits`` logits of ``text``, read in random pieces beside other texts."""
    ours, other = (Slot(model.layers, len(text)) for _ in range(2))
    start, beside, found = 0, 0, []
    with model.session(), model.adapter(""):
        while start < len(text):
            n = min(draw.choice([1, 1, 2, 7, 16, 33, 100, 250]), len(text) - start)
            m = min(draw.choice([0, 1, 5, 64]), len(text) - beside)
            wanted = max(0, min(n, start + n - (len(text) - logits)))
            segments = [Segment(ours, text[start : start + n], start, wanted)]
            if m:
                stranger = Segment(other, text[::-1][beside : beside + m], beside, 0)
                segments.insert(draw.randrange(2), stranger)
            outputs = model.forward(segments)
            found.append(next(o for o, s in zip(outputs, segments, strict=True) if s.slot is ours))
            start, beside = start + n, beside + m
    return torch.cat(found)


def check_reading(model: Any, length: int, trials: int, seed: int = 0) -> None:
    packed = PackedModel(model)
    packed.check()
    draw = random.Random(seed)
    text = [draw.randrange(len(model.get_input_embeddings().weight)) for _ in range(length)]
    slot = Slot(packed.layers, length)
    with packed.session(), packed.adapter(""):
        (whole,) = packed.forward([Segment(slot, text, 0, 40)])
    for _ in range(trials):
        assert torch.equal(read(packed, text, draw, 40), whole)


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("length", [90, 530, 1100], ids=lambda n: f"{n} tokens")
def test_logits_are_the_same_in_whatever_pieces_a_text_is_read(length: int, count: int) -> None:
    with threads(count):
        check_reading(tiny().model, length, trials=3, seed=length + count)


@pytest.mark.parametrize(
    "shape",
    [
        {"hidden_size": 96, "intermediate_size": 200, "num_attention_heads": 3, "num_key_value_heads": 1},
        {"num_attention_heads": 1, "num_key_value_heads": 1, "head_dim": 64},
        {"hidden_size": 576, "intermediate_size": 1536, "num_attention_heads": 9, "num_key_value_heads": 3},
        {"hidden_size": 64, "intermediate_size": 75, "head_dim": 24},
    ],
    ids=["one key-value head", "one head", "SmolLM2's widths", "odd widths"],
)
@pytest.mark.parametrize("count", [1, 8])
def test_shapes_that_have_kernels_of_their_own(shape: dict[str, int], count: int) -> None:
    """Single heads are multiplied by all threads; 1,536 numbers are summed otherwise in one row; 75 end in a vector."""
    model = tiny_model(tiny_tokenizer(), **shape).eval()
    with threads(count):
        check_reading(model, 600, trials=2)
        check_reading(adapted(model), 150, trials=2)
        assert PackedModel(model).invariant()


@pytest.mark.slow
@needs_smollm2
def test_the_bundled_model_is_batch_invariant_with_an_adapter() -> None:
    model = LocalLLM.load(next(iter(BUNDLED)), dtype="float32", device="cpu").model
    assert PackedModel(model).invariant()
    check_reading(adapted(model), 560, trials=3)


@pytest.mark.parametrize("batching", ["auto", *get_args(Batching)])
@pytest.mark.parametrize("bounds", [{}, {"max_batch": 2}, {"max_cache_tokens": 512}], ids=str)
def test_an_episode_is_the_same_alone_and_among_others(batching: Any, bounds: dict[str, int]) -> None:
    alone = [asyncio.run(episode(tiny(), name, LENGTHS[name])) for name in LENGTHS]
    together = play(tiny(batching=batching, **bounds), pauses=3)
    for expected, calls in zip(alone, together, strict=True):
        assert [c.completions for c in calls] == [c.completions for c in expected]


def test_scores_are_the_same_alone_and_among_others() -> None:
    continuations = ["go north", "go", "wait here for a while and then go"]

    def scores(llm: LocalLLM, busy: bool) -> tuple[float, ...]:
        async def main() -> tuple[float, ...]:
            others = [llm.generate(request([user("x" * i)], id=i, max_tokens=9)) for i in range(1, 9 * busy)]
            found, *_ = await asyncio.gather(llm.score([user("Where to?")], continuations), *others)
            return found

        return asyncio.run(main())

    assert scores(tiny(), busy=True) == scores(tiny(), busy=False)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 16])
@pytest.mark.parametrize("width", [1536, 4864, 75, 40000])
def test_activations_are_the_same_in_however_many_rows(count: int, width: int) -> None:
    # From 5 threads on 86 rows of 1,536 numbers are shared so that a share ends within a vector.
    torch.manual_seed(0)
    x = torch.randn(1, 101, width)
    with threads(count):
        whole = elementwise(torch.nn.functional.silu, x)
        assert torch.allclose(whole, torch.nn.functional.silu(x), rtol=1e-6)
        for rows in (1, 2, 31, 86, 87, 100):
            assert torch.equal(elementwise(torch.nn.functional.silu, x[:, :rows]), whole[:, :rows])


def depends_on_the_batch(module: Any, inputs: Any, output: torch.Tensor) -> torch.Tensor:
    return output * (1 + 1e-6 * output.shape[1])


def test_auto_waits_for_nobody_only_where_that_is_repeatable() -> None:
    llm, rounding = tiny(), tiny()
    rounding.model.model.norm.register_forward_hook(depends_on_the_batch)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asyncio.run(llm.generate(request([user("hello")], max_tokens=2)))
    assert llm.batching == "continuous"
    with pytest.warns(UserWarning, match=r"depend.*Qwen3ForCausalLM, float32 on cpu.*batches are closed"):
        asyncio.run(rounding.generate(request([user("hello")], max_tokens=2)))
    assert rounding.batching == "closed"


def far_tokens_only(module: Any, inputs: Any, output: torch.Tensor) -> torch.Tensor:
    """In forwards of 300 tokens and more, the 200th and later ones come out otherwise."""
    output = output.clone()
    if output.shape[1] >= 300:
        output[:, 200:] += 1e-6
    return output


def test_the_probe_reads_far_enough() -> None:
    """What differs in long forwards only, which a probe of 97 tokens never made."""
    model = tiny_model(tiny_tokenizer()).eval()
    assert PackedModel(model).invariant()
    model.model.layers[0].register_forward_hook(lambda m, i, o: far_tokens_only(m, i, o))
    assert not PackedModel(model).invariant()


@pytest.mark.parametrize("position", [3, 131, 520, 1000, 1060, 1099])
def test_the_probe_notices_a_token_that_knows_how_it_was_read(position: int) -> None:
    model = tiny_model(tiny_tokenizer()).eval()

    def rotated_otherwise(module: Any, inputs: Any, output: Any) -> Any:
        here = inputs[1][0] == position
        scale = (1 + 1e-5 * (here & (inputs[1].shape[1] > 100)).float())[None, :, None]
        return tuple(x * scale for x in output)

    model.model.rotary_emb.register_forward_hook(rotated_otherwise)
    assert not PackedModel(model).invariant()


def test_the_probe_runs_once_for_models_of_one_kind_and_again_for_other_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(probe, "_KNOWN", {})
    asked: list[int] = []
    agrees = probe._agrees
    monkeypatch.setattr(probe, "_agrees", lambda *a: asked.append(torch.get_num_threads()) or agrees(*a))
    texts = len(probe._CUTS)
    first, second = (PackedModel(tiny_model(tiny_tokenizer(), seed=seed).eval()) for seed in (0, 1))
    assert [first.invariant(), first.invariant(), second.invariant()] == [True] * 3
    assert asked == [torch.get_num_threads()] * texts
    with threads(3):
        assert first.invariant()
    assert asked[texts:] == [3] * texts


def test_the_probe_runs_few_layers_and_leaves_the_model_as_it_was() -> None:
    model = tiny_model(tiny_tokenizer(), num_hidden_layers=6).eval()
    ran: list[int] = []
    for i, layer in enumerate(model.model.layers):
        layer.register_forward_hook(lambda *_, i=i: ran.append(i))
    assert PackedModel(model).invariant()
    # The check before it runs all layers three times, and the model's own forward once.
    assert [ran.count(i) for i in range(2, 6)] == [3] * 4 and ran.count(1) > 20
    assert model.config.num_hidden_layers == 6
    assert model(torch.tensor([[1, 2, 3]])).logits.shape[1] == 3


def test_without_its_measures_the_engine_is_not_taken_for_invariant(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the machine's plain products depend on the number of rows, the probe says so of the plain products."""
    x, w = torch.randn(64, 64), torch.randn(128, 64)
    plain = [torch.nn.functional.linear(x[:n], w) for n in (1, 2, 3, 64)]
    differs = any(not torch.equal(p, plain[-1][: len(p)]) for p in plain)
    monkeypatch.setattr("agentspec.llm.local.invariance.packs", lambda: False)
    monkeypatch.setattr("agentspec.llm.local.forward._MIN_ROWS", {})
    monkeypatch.setattr("agentspec.llm.local.attention._QUERIES", {})
    monkeypatch.setattr(probe, "_KNOWN", {})
    assert not differs or not PackedModel(tiny().model).invariant()


def logits_of(model: Any, modules: InvariantModules) -> torch.Tensor:
    with torch.no_grad(), modules.in_use():
        out: torch.Tensor = model(torch.arange(5, 45)[None]).logits
    return out


@pytest.mark.parametrize("config", [{}, {"use_rslora": True}, {"use_dora": True}, {"lora_bias": True}], ids=str)
def test_packed_weights_compute_what_the_model_computes(config: dict[str, Any]) -> None:
    model = adapted(tiny_model(tiny_tokenizer()), **config)
    modules = InvariantModules(model)
    with torch.no_grad():
        expected = model(torch.arange(5, 45)[None]).logits
        assert torch.allclose(logits_of(model, modules), expected, atol=2e-5)
        with model.disable_adapter():
            base = model(torch.arange(5, 45)[None]).logits
            assert torch.allclose(logits_of(model, modules), base, atol=2e-5)
        assert not torch.allclose(base, expected, atol=1e-2)
    # And the modules are themselves again.
    assert not any("forward" in vars(m) for m in model.modules())


def test_weights_are_packed_again_when_they_change_and_only_then(monkeypatch: pytest.MonkeyPatch) -> None:
    model = adapted(tiny_model(tiny_tokenizer()))
    modules = InvariantModules(model)
    packed: list[int] = []
    reorder = torch.ops.mkldnn._reorder_linear_weight
    monkeypatch.setattr(
        torch.ops.mkldnn, "_reorder_linear_weight", lambda w, *a: packed.append(w.numel()) or reorder(w, *a)
    )
    first = logits_of(model, modules)
    # Two layers of seven linear layers each, and the head, which carries no adapter.
    assert len(packed) == 15
    assert torch.equal(logits_of(model, modules), first) and len(packed) == 15
    # An optimiser writes in place: the layers with an adapter follow, the head is kept.
    with torch.no_grad():
        for name, p in model.named_parameters():
            if "lora_B" in name:
                p.mul_(-1)
    second = logits_of(model, modules)
    assert len(packed) == 29
    with torch.no_grad():
        assert torch.allclose(second, model(torch.arange(5, 45)[None]).logits, atol=2e-5)
    assert not torch.allclose(first, second, atol=1e-2)
    modules.clear()
    assert torch.equal(logits_of(model, modules), second) and len(packed) == 44


def test_what_a_hook_or_wrapper_does_to_a_layer_is_still_done() -> None:
    model = tiny_model(tiny_tokenizer()).eval()
    seen: list[str] = []
    model.lm_head.register_forward_hook(lambda *_: seen.append("hook"))
    gate = model.model.layers[0].mlp.gate_proj
    original = gate.forward
    gate.forward = lambda x: seen.append("wrapper") or original(x)
    logits_of(model, InvariantModules(model))
    assert seen == ["wrapper", "hook"]
    assert "forward" in vars(gate)


def test_recorded_logprobs_are_the_training_forwards_under_an_adapter() -> None:
    """Invariant 1 with merged and packed weights, recomputed by the unmerged model with its own products."""
    tokenizer = tiny_tokenizer()
    llm = LocalLLM(adapted(tiny_model(tokenizer)), tokenizer, name="lora")
    for seed in range(3):
        call = asyncio.run(llm.generate(request([user("hello " * 20)], seed=seed, max_tokens=30)))
        ids = [*call.prompt_ids, *call.completions[0].token_ids]
        with torch.no_grad():
            logprobs = llm.model(torch.tensor([ids])).logits[0].log_softmax(-1)
        own = logprobs[len(call.prompt_ids) - 1 : -1].gather(1, torch.tensor(ids[len(call.prompt_ids) :])[:, None])
        assert close(call.completions[0].logprobs, own[:, 0].tolist(), 1e-5)
