"""Batch invariance: what a token's logits are, to the last bit, depends on its context only."""

from __future__ import annotations

import asyncio
import random
from typing import Any, get_args

import pytest
import torch

from agentspec.llm.base import user
from agentspec.llm.batching import Batching
from agentspec.llm.local import LocalLLM
from agentspec.llm.local_attention import Segment, slot_block
from agentspec.llm.local_cache import Slot
from agentspec.llm.local_forward import PackedModel
from agentspec.llm.models import BUNDLED
from tests.llm.helpers import request
from tests.llm.test_local import tiny
from tests.llm.test_local_batching import LENGTHS, episode, play


def products_are_invariant() -> bool:
    """Whether this machine multiplies a row the same way however many there are; all else is the backend's duty."""
    x, w = torch.randn(70, 96), torch.randn(192, 96)
    whole = torch.nn.functional.linear(x, w)
    return all(torch.equal(torch.nn.functional.linear(x[:n], w), whole[:n]) for n in (1, 2, 5, 17, 40))


pytestmark = pytest.mark.skipif(
    not products_are_invariant(),
    reason="on this machine products of matrices are not batch-invariant (MKL: AUTO,STRICT)",
)


def read(model: PackedModel, text: list[int], draw: random.Random, logits: int) -> torch.Tensor:
    """The last ``logits`` logits of ``text``, read in random pieces beside other texts."""
    ours, other = (Slot(model.layers, len(text), slot_block(model.device)) for _ in range(2))
    start, beside, found = 0, 0, []
    with model.session():
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


def check_reading(model: Any, length: int, trials: int) -> None:
    packed = PackedModel(model)
    packed.check()
    draw = random.Random(0)
    text = [draw.randrange(len(model.get_input_embeddings().weight)) for _ in range(length)]
    slot = Slot(packed.layers, length, slot_block(packed.device))
    with packed.session():
        (whole,) = packed.forward([Segment(slot, text, 0, 40)])
    for _ in range(trials):
        assert torch.equal(read(packed, text, draw, 40), whole)


@pytest.mark.parametrize("length", [90, 530, 1100], ids=lambda n: f"{n} tokens")
def test_logits_are_the_same_in_whatever_pieces_a_text_is_read(length: int) -> None:
    check_reading(tiny().model, length, trials=5)


@pytest.mark.slow
def test_the_bundled_model_is_batch_invariant_with_an_adapter() -> None:
    from peft import LoraConfig, get_peft_model

    model = LocalLLM.load(next(iter(BUNDLED)), dtype="float32", device="cpu").model
    torch.manual_seed(0)
    adapted = get_peft_model(model, LoraConfig(r=16, target_modules="all-linear", init_lora_weights=False))
    check_reading(adapted.eval(), 560, trials=3)


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


def test_auto_waits_for_nobody_only_where_that_is_repeatable() -> None:
    llm, rounding = tiny(), tiny()

    def depends_on_the_batch(module: Any, inputs: Any, output: torch.Tensor) -> torch.Tensor:
        return output * (1 + 1e-6 * output.shape[1])

    rounding.model.model.norm.register_forward_hook(depends_on_the_batch)
    for backend in (llm, rounding):
        asyncio.run(backend.generate(request([user("hello")], max_tokens=2)))
    assert llm._batcher.batching == "eager"
    assert rounding._batcher.batching == "ordered"
