"""The local backend with continuous batches: the same answers, right log-probabilities, in fewer forwards."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, get_args

import pytest
import torch

from agentspec.llm.base import LLMError, Sampled, assistant, system, user
from agentspec.llm.batching import Batching
from agentspec.llm.local import LocalLLM
from agentspec.llm.local.rows import Job
from agentspec.types import LLMCall, Sampling
from tests.llm.helpers import request
from tests.llm.test_local import close, recomputed, tiny
from tests.llm.test_local_adapters import backend, plain_logprobs, tagged

LENGTHS = {"a": [3, 24, 5, 9], "b": [30, 4, 4], "c": [2, 2, 2, 2, 40], "d": [11, 17, 6], "e": [25, 25]}
CHOICES = ("go north", "go", "wait")


async def episode(llm: LocalLLM, name: str, lengths: list[int], pauses: random.Random | None = None) -> list[LLMCall]:
    """An append-only episode that asks for answers of given lengths, and a choice after each; acts for a while."""
    llm.enter(name)
    try:
        calls: list[LLMCall] = []
        messages = [system("Rules of the house. " * 8), user(f"Episode {name}.")]
        for turn, n in enumerate(lengths):
            for options in ({"max_tokens": n}, {"choices": CHOICES}):
                seed = 100 * turn + len(messages)
                calls.append(await llm.generate(request(messages, episode=name, seed=seed, id=len(calls), **options)))
                messages += [assistant(Sampled.of(calls[-1].completions[0])), user(f"Turn {turn}.")]
            if pauses:
                await asyncio.sleep(pauses.choice([0.0, 0.002, 0.01]))
        return calls
    finally:
        llm.leave(name)


def play(llm: LocalLLM, pauses: int | None = None, at_once: int = 5) -> list[list[LLMCall]]:
    async def main() -> list[list[LLMCall]]:
        gate = asyncio.Semaphore(at_once)

        async def guarded(name: str) -> list[LLMCall]:
            async with gate:
                draw = None if pauses is None else random.Random(pauses + len(name))
                return await episode(llm, name, LENGTHS[name], draw)

        return list(await asyncio.gather(*map(guarded, LENGTHS)))

    return asyncio.run(asyncio.wait_for(main(), 60))


def written(played: list[list[LLMCall]]) -> list[Any]:
    return [[c.completions[0].token_ids for c in calls] for calls in played]


def exactly(played: list[list[LLMCall]]) -> list[Any]:
    return [[(c.completions[0], c.usage) for c in calls] for calls in played]


def counted(llm: LocalLLM, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Rows of every forward of ``llm`` from now on."""
    forward, rows = llm._engine.model.forward, []

    def count(segments: Any) -> Any:
        rows.append(len(segments))
        return forward(segments)

    llm._engine.model.check()
    monkeypatch.setattr(llm._engine.model, "forward", count)
    return rows


@pytest.fixture(scope="module")
def expected() -> list[Any]:
    """What the episodes write, each alone."""
    calls = [asyncio.run(episode(tiny(batching="closed"), name, LENGTHS[name])) for name in LENGTHS]
    return written(calls)


@pytest.mark.parametrize("batching", get_args(Batching))
@pytest.mark.parametrize("bounds", [{}, {"max_batch": 2}, {"max_cache_tokens": 256}], ids=str)
def test_the_same_answers_however_they_are_batched(
    batching: Batching, bounds: dict[str, int], expected: list[Any]
) -> None:
    llm = tiny(batching=batching, **bounds)
    played = play(llm, pauses=1)
    assert written(played) == expected
    for calls in played:
        assert all(close(c.completions[0].logprobs, recomputed(llm, c)) for c in calls)
        # The last token of the turn before is all that is new of it.
        assert bounds or all(b.usage.cached_tokens >= len(a.prompt_ids) for a, b in pairwise(calls))


def test_continuous_batches_take_fewer_forwards(monkeypatch: pytest.MonkeyPatch) -> None:
    forwards = {}
    for batching in get_args(Batching):
        llm = tiny(batching=batching)
        rows = counted(llm, monkeypatch)
        play(llm)
        forwards[batching] = len(rows)
    assert forwards["continuous"] < 0.9 * forwards["closed"]


@pytest.mark.parametrize("options", [{}, {"max_batch": 3}, {"at_once": 2}], ids=str)
def test_closed_batches_are_repeatable_to_the_last_bit(options: dict[str, int]) -> None:
    at_once = options.get("at_once", 5)
    bounds = {k: v for k, v in options.items() if k != "at_once"}
    first, *others = [exactly(play(tiny(batching="closed", **bounds), seed, at_once)) for seed in range(4)]
    assert others == [first] * 3


def test_rows_that_join_take_over_what_running_rows_have_read(monkeypatch: pytest.MonkeyPatch) -> None:
    llm = tiny(batching="continuous")
    llm._engine._stop_ids = frozenset()  # the first answer lasts
    rows = counted(llm, monkeypatch)
    static = system("Rules of the house. " * 20)
    shared = len(llm.chat.encode(static.text))

    async def main() -> tuple[LLMCall, LLMCall]:
        long = asyncio.create_task(llm.generate(request([static, user("write")], max_tokens=600)))
        while len(rows) < 5:
            await asyncio.sleep(0.001)
        short = await llm.generate(request([static, user("look")], id=1, max_tokens=3))
        assert not long.done()
        return await long, short

    long, short = asyncio.run(main())
    assert close(long.completions[0].logprobs, recomputed(llm, long))
    assert close(short.completions[0].logprobs, recomputed(llm, short))
    assert short.usage.cached_tokens >= shared


@pytest.mark.parametrize("batching", get_args(Batching))
@pytest.mark.parametrize("tokens_per_forward", [16, 512])
def test_slots_that_are_continued_while_others_still_copy_from_them(
    batching: Batching, tokens_per_forward: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rebuilt prompts of all lengths, several samples, short answers: slots change hands at every forward."""
    monkeypatch.setattr("agentspec.llm.local.engine._TOKENS_PER_FORWARD", {"cpu": tokens_per_forward})
    llm = tiny(batching=batching, max_batch=5, max_cache_tokens=1024)
    draw = random.Random(5)
    words = [f"word{i} " for i in range(24)]

    async def rebuilt(name: str, steps: int) -> list[LLMCall]:
        llm.enter(name)
        calls = []
        for step in range(steps):
            text = "".join(words[: draw.randint(1, 24)]) + name * draw.randint(0, 9)
            sampling = draw.choice([{"max_tokens": 2}, {"choices": CHOICES}, {"max_tokens": 5, "n": 2}])
            calls.append(await llm.generate(request([user(text)], episode=name, id=step, seed=step, **sampling)))
        llm.leave(name)
        return calls

    async def main() -> list[list[LLMCall]]:
        return list(await asyncio.gather(*[rebuilt(name, 3 + i) for i, name in enumerate("abcdefg")]))

    for calls in asyncio.run(main()):
        for call in calls:
            for i, completion in enumerate(call.completions):
                assert close(completion.logprobs, recomputed(llm, call, i))


def test_a_slot_that_changes_hands_is_copied_first(monkeypatch: pytest.MonkeyPatch) -> None:
    # Forwards of 16 tokens: ``first`` reads 16, 16 and is done; ``copies`` has not yet copied its 32 tokens when
    # ``takes``, the next prompt of the same episode, continues the slot from its 20th token on and makes it larger.
    monkeypatch.setattr("agentspec.llm.local.engine._TOKENS_PER_FORWARD", {"cpu": 16})
    llm = tiny()
    base, one = list(range(40, 72)), Sampling(max_tokens=1)
    first = Job("a", base, one)
    copies = Job("b", [*base, 5, 6, 7], one)
    takes = Job("a", [*base[:20], *range(100, 200)], one)
    joining = [takes]

    def exchange(done: Sequence[Job]) -> list[Job]:
        return [joining.pop() for job in done if job is first]

    llm._engine.run([first, copies], exchange)
    assert (copies.cached, takes.cached) == (32, 20)
    for job in (first, copies, takes):
        with torch.no_grad():
            logprobs = llm.model(torch.tensor([job.prompt])).logits[0, -1].log_softmax(-1)
        (completion,) = job.completions
        assert close(completion.logprobs, [float(logprobs[completion.token_ids[0]])])


def test_what_an_ended_episode_cached_is_anyones_when_others_join() -> None:
    llm = tiny()

    def owners() -> list[str | None]:
        return [slot.owner for slot in llm._engine.cache._slots]

    asyncio.run(episode(llm, "a", [1]))
    # Not before: when an episode ends hangs on timing, and which slots others may take must not.
    assert owners() == ["a"]
    asyncio.run(llm.generate(request([user("another prompt")], max_tokens=1)))
    assert None in owners() and "a" not in owners()


@pytest.mark.parametrize("batching", get_args(Batching))
def test_only_the_request_at_fault_fails_while_others_write(
    batching: Batching, monkeypatch: pytest.MonkeyPatch, expected: list[Any]
) -> None:
    llm = tiny(batching=batching)
    llm._engine.model.check()
    forward = llm._engine.model.forward

    def fragile(segments: Any) -> Any:
        if any(9 in s.tokens and 10 in s.tokens for s in segments):
            raise RuntimeError("out of memory")
        return forward(segments)

    monkeypatch.setattr(llm._engine.model, "forward", fragile)

    async def bad() -> list[LLMCall]:
        llm.enter("bad")
        try:
            first = await llm.generate(request([user("u")], episode="bad", max_tokens=5))
            await llm.generate(request([user("u"), assistant(Sampled("x", (9, 10)))], episode="bad", id=1))
            return [first]
        finally:
            llm.leave("bad")

    async def main() -> list[Any]:
        others = [episode(llm, name, lengths) for name, lengths in LENGTHS.items()]
        return list(await asyncio.gather(bad(), *others, return_exceptions=True))

    failed, *played = asyncio.run(asyncio.wait_for(main(), 60))
    assert isinstance(failed, LLMError) and "out of memory" in str(failed)
    assert written(played) == expected


def test_the_model_is_itself_again_when_the_last_answer_is_there() -> None:
    llm = tiny(batching="continuous")
    attention = llm.model.config._attn_implementation
    for _ in range(3):
        play(llm)
        assert llm.model.config._attn_implementation == attention
        assert not llm._engine.model.model.training
        llm.model(torch.tensor([[1, 2, 3]]))


@pytest.mark.parametrize("batching", get_args(Batching))
def test_adapters_take_turns_in_a_continuous_batch(batching: Batching) -> None:
    """An adapter that is asked all the time does not keep the other from its turn."""
    llm = backend(batching=batching)
    order: list[str] = []

    async def asks(name: str, path: str, turns: int, tokens: int) -> list[LLMCall]:
        llm.enter(name)
        calls = []
        for turn in range(turns):
            plain = tagged(path, user(f"{name} {turn}"), id=turn, seed=turn, max_tokens=tokens)
            calls.append(await llm.generate(replace(plain, tag=replace(plain.tag, episode=name))))
            order.append(path)
        llm.leave(name)
        return calls

    async def main() -> list[list[LLMCall]]:
        actors = [asks(f"actor{i}", "reasoning.x/decide", 6, 4 + i) for i in range(3)]
        return list(await asyncio.gather(*actors, asks("reflector", "reflection.x/y", 2, 5)))

    *actors, reflector = asyncio.run(asyncio.wait_for(main(), 60))
    for calls, adapter in [*((c, "actor") for c in actors), (reflector, "reflector")]:
        for call in calls:
            assert close(call.completions[0].logprobs, plain_logprobs(llm, call, adapter))
    assert order.index("reflection.x/y") < 8
    assert llm.model.active_adapter == "actor"
