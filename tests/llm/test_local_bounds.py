"""What the local engine holds and multiplies, counted: bytes of keys and values, sizes of products, tokens computed."""

from __future__ import annotations

import asyncio
import gc
from typing import Any

import pytest
import torch

from agentspec.llm.base import system, user
from agentspec.llm.local import LocalLLM, blocks
from agentspec.llm.local.attention import Segment
from agentspec.llm.local.blocks import WHOLE, last_blocks, padded
from agentspec.llm.local.cache import PrefixCache, Slot
from agentspec.llm.local.forward import PackedModel
from agentspec.types import LLMCall
from tests.llm.helpers import request
from tests.llm.test_local import tiny
from tests.tiny import tiny_model, tiny_tokenizer


def positions_held() -> int:
    """Positions for which any slot alive, wherever it is, has room."""
    return sum(slot.capacity for slot in gc.get_objects() if type(slot) is Slot)


async def snapshots(llm: LocalLLM, name: str, calls: int) -> list[LLMCall]:
    """An episode whose prompts share their beginning only, with several samples each."""
    llm.enter(name)
    try:
        return [
            await llm.generate(
                request(
                    [system("Rules. " * 5), user(f"Episode {name}, step {i}: {(name + str(i)) * 40}")],
                    episode=name,
                    id=i,
                    seed=i,
                    n=3,
                    max_tokens=4 + i,
                )
            )
            for i in range(calls)
        ]
    finally:
        llm.leave(name)


@pytest.mark.parametrize("batching", ["continuous", "closed"])
def test_the_bound_of_the_cache_bounds_what_running_calls_hold_too(
    batching: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five episodes of three samples need 15 slots at once; the bound has room for fewer."""

    def play(bound: int) -> tuple[list[Any], int]:
        gc.collect()
        before = positions_held()
        llm = tiny(batching=batching, max_cache_tokens=bound)
        model = llm._engine.model
        model.check()
        forward, held = model.forward, []

        def counted(segments: Any) -> Any:
            held.append(positions_held() - before)
            return forward(segments)

        monkeypatch.setattr(model, "forward", counted)

        async def main() -> list[list[LLMCall]]:
            return list(await asyncio.gather(*(snapshots(llm, name, 4) for name in "abcde")))

        played = asyncio.run(asyncio.wait_for(main(), 120))
        assert llm._engine.cache.running == 0
        return [[c.completions for c in calls] for calls in played], max(held)

    free, most = play(1 << 20)
    bounded, held = play(2048)
    assert held <= 2048 < most
    assert bounded == free


def test_room_is_made_before_slots_are_taken_and_running_slots_count() -> None:
    cache = PrefixCache(layers=1, max_tokens=512)
    slots = cache.assign([([i] * 100, 99, str(i), 128) for i in range(4)])
    assert (cache.running, cache.tokens) == (512, 512)
    for i, slot in enumerate(slots[:2]):
        cache.put(slot, [i] * 100)
    cache.drop(slots[2])
    assert (cache.running, cache.tokens, len(cache)) == (128, 384, 2)
    # A running slot grows: the least recently used one of the others goes.
    slots[3].reserve(320)
    cache.trim()
    assert (cache.running, cache.tokens, [s.tokens[0] for s in cache._slots]) == (320, 448, [1])
    # What comes back after all were forgotten is not kept.
    cache.clear()
    cache.put(slots[3], [3] * 100)
    assert cache.tokens == 0


def test_products_are_made_of_few_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    """oneDNN keeps a compiled product for every number of rows: of 120 numbers of tokens 16 are left."""
    multiply, sizes = torch.ops.mkldnn._linear_pointwise, set()

    def counted(x: torch.Tensor, *args: Any) -> torch.Tensor:
        sizes.add(x.shape[-2])
        return multiply(x, *args)

    model = PackedModel(tiny_model(tiny_tokenizer()).eval())
    model.check()
    monkeypatch.setattr(torch.ops.mkldnn, "_linear_pointwise", counted)
    with model.session(), model.adapter(""):
        for n in range(1, 121):
            model.forward([Segment(Slot(model.layers, 128), list(range(n)), 0, min(n, 9))])
    assert sizes == {4, *range(8, 121, 8)}


def test_the_last_layer_computes_what_is_wanted_and_nothing_else() -> None:
    tokens = list(range(5, 45))
    plain = tiny_model(tiny_tokenizer()).eval()
    model = PackedModel(plain)
    model.check()
    rows: list[list[int]] = []
    acts = [layer.mlp.act_fn for layer in plain.model.layers]
    for act in acts:
        act.register_forward_hook(lambda m, i, o: rows.append([acts.index(m), i[0].shape[-2]]))

    def read(*wanted: int) -> list[torch.Tensor]:
        segments = [Segment(Slot(model.layers, 64), tokens, 0, n) for n in wanted]
        with model.session(), model.adapter(""):
            return model.forward(segments)

    hooked = read(1, 0, 2)
    assert rows == [[0, 120], [1, 120]]  # what somebody watches is computed whole
    for act in acts:
        act._forward_hooks.clear()
    pieces: list[int] = []
    down = plain.model.layers[-1].mlp
    original = type(down).forward
    try:
        type(down).forward = lambda self, x: pieces.append(x.shape[1]) or original(self, x)  # type: ignore[method-assign]
        narrowed = read(1, 0, 2)
    finally:
        type(down).forward = original  # type: ignore[method-assign]
    assert pieces == [120, 4]  # three are wanted, and a product has four rows
    assert all(torch.equal(a, b) for a, b in zip(narrowed, hooked, strict=True))
    assert "forward" not in vars(down)


def test_a_short_last_block_gives_the_bits_of_a_whole_one() -> None:
    assert padded(700, (64, 384, WHOLE)) == 512 + 384
    found = last_blocks(16, torch.get_num_threads())
    assert found[-1] == WHOLE and list(found) == sorted(set(found))
    keys, values = torch.randn(2, 1, 2, WHOLE, 16)
    queries = torch.randn(1, 2, 4, 16)
    whole = torch.full((4, WHOLE), float("-inf"))
    whole[:, :60] = 0
    attend = torch.nn.functional.scaled_dot_product_attention
    expected = attend(queries, keys, values, attn_mask=whole)
    for n in found:
        short = attend(queries, keys[:, :, :n], values[:, :, :n], attn_mask=whole[:, :n].contiguous())
        assert torch.equal(short, expected)


def test_where_short_blocks_turn_out_otherwise_whole_ones_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agentspec.llm.local.probe._KNOWN", {})
    monkeypatch.setattr("agentspec.llm.local.forward.last_blocks", lambda *_: (64, 256, WHOLE))
    attend = torch.nn.functional.scaled_dot_product_attention

    def lengthy(q: Any, k: Any, v: Any, **kwargs: Any) -> torch.Tensor:
        return attend(q, k, v, **kwargs) * (1 + 1e-5 * (k.shape[2] % WHOLE == 256))

    monkeypatch.setattr("agentspec.llm.local.attention.scaled_dot_product_attention", lengthy)
    model = PackedModel(tiny_model(tiny_tokenizer()).eval())
    assert model.last_blocks == (64, 256, WHOLE)
    assert model.invariant() and model.last_blocks == (WHOLE,)
    assert blocks.padded(700, model.last_blocks) == 2 * WHOLE
