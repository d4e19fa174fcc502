"""The local backend: what it samples, that recorded log-probabilities are the model's, and what it leaves untouched."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import pytest
import torch

from agentspec.llm.base import LLM, ContextOverflowError, LLMError, Sampled, assistant, system, user
from agentspec.llm.local import LocalLLM
from agentspec.types import LLMCall
from tests.llm.helpers import needs_smollm2, request, smollm2
from tests.tiny import tiny_model, tiny_tokenizer

CHOICES = ("go", "go north", "wait", "pick up")


def tiny(**kwargs: Any) -> LocalLLM:
    tokenizer = tiny_tokenizer()
    return LocalLLM(tiny_model(tokenizer).eval(), tokenizer, name="tiny", **kwargs)


def ask(llm: LocalLLM, *messages, **kwargs) -> LLMCall:
    return asyncio.run(llm.generate(request(messages or (system("s"), user("hello")), **kwargs)))


def recomputed(llm: LocalLLM, call: LLMCall, index: int = 0) -> list[float]:
    """Log-probabilities of a completion by one plain forward over prompt and completion."""
    completion = call.completions[index]
    ids = [*call.prompt_ids, *completion.token_ids]
    with torch.no_grad():
        logits = llm.model(torch.tensor([ids]), use_cache=False).logits[0].float()
    logits = logits[len(call.prompt_ids) - 1 : -1] / (call.sampling.temperature or 1.0)
    allowed = completion.allowed or (None,) * len(completion.token_ids)
    values = []
    for line, token, ids_allowed in zip(logits, completion.token_ids, allowed, strict=True):
        keep = line if ids_allowed is None else line[list(ids_allowed)]
        values.append(float(line[token] - keep.logsumexp(-1)))
    return values


def close(a, b, tolerance=1e-4) -> bool:
    return len(a) == len(b) and max(abs(x - y) for x, y in zip(a, b, strict=True)) < tolerance


async def converse(llm: LocalLLM, name: str, turns: int, **sampling: Any) -> list[LLMCall]:
    """An append-only episode of free and constrained turns; texts, and so lengths, differ by episode."""
    llm.enter(name)
    try:
        messages = [system("You act in a world of rooms."), user(f"Episode {name}. " + "Look. " * len(name))]
        calls = []
        for turn in range(turns):
            options = {"choices": CHOICES} if turn % 2 else {"max_tokens": 6 + len(name)}
            asked = request(messages, episode=name, seed=hash(len(name)) + turn, id=turn, **options, **sampling)
            call = await llm.generate(asked)
            calls.append(call)
            messages += [assistant(Sampled.of(call.completions[0])), user(f"Turn {turn} is over.")]
        return calls
    finally:
        llm.leave(name)


def converse_all(llm: LocalLLM, names: list[str], turns: int = 4, **sampling: Any) -> list[list[LLMCall]]:
    async def main():
        return await asyncio.gather(*[converse(llm, n, turns, **sampling) for n in names])

    return asyncio.run(main())


def test_recorded_logprobs_are_the_models_over_turns_and_batches():
    llm = tiny()
    assert isinstance(llm, LLM)
    for calls in converse_all(llm, ["a", "bbb", "cc", "dddddd"], temperature=0.7):
        for before, call in zip([None, *calls], calls, strict=False):
            assert close(call.completions[0].logprobs, recomputed(llm, call))
            if before is not None:
                start = before.prompt_ids + before.completions[0].token_ids
                assert call.prompt_ids[: len(start)] == start
                # All but the last token of the turn before was computed already.
                assert call.usage.cached_tokens >= len(before.prompt_ids)


def test_results_do_not_depend_on_the_batch():
    together = converse_all(tiny(), ["a", "bbb", "cc"])
    for name, calls in zip(["a", "bbb", "cc"], together, strict=True):
        (alone,) = converse_all(tiny(), [name])
        assert [c.completions[0].token_ids for c in alone] == [c.completions[0].token_ids for c in calls]


def test_small_batches_and_caches_change_nothing():
    expected = converse_all(tiny(), ["a", "bbb", "cc"])
    for llm in (tiny(max_batch=1), tiny(max_cache_tokens=64)):
        got = converse_all(llm, ["a", "bbb", "cc"])
        assert [[c.completions[0].token_ids for c in x] for x in got] == [
            [c.completions[0].token_ids for c in x] for x in expected
        ]
    assert llm._engine.cache.tokens <= 64


def test_samples_share_the_prompt_and_differ():
    llm = tiny()
    call = ask(llm, n=4, max_tokens=12)
    assert len({c.token_ids for c in call.completions}) == 4
    for i, completion in enumerate(call.completions):
        assert close(completion.logprobs, recomputed(llm, call, i))
    assert call.completions[0].token_ids == ask(tiny(), max_tokens=12).completions[0].token_ids
    assert call.usage.output_tokens == sum(len(c.token_ids) for c in call.completions)


def test_same_seed_same_sample_other_seed_other():
    llm = tiny()
    first, again, other = (ask(llm, seed=s, max_tokens=20).completions[0].token_ids for s in (1, 1, 2))
    assert first == again != other


def test_greedy_takes_the_best():
    llm = tiny()
    (completion,) = (call := ask(llm, temperature=0, max_tokens=8)).completions
    with torch.no_grad():
        logits = llm.model(torch.tensor([[*call.prompt_ids, *completion.token_ids]])).logits[0]
    best = logits[len(call.prompt_ids) - 1 : -1].argmax(-1).tolist()
    assert list(completion.token_ids) == best
    assert close(completion.logprobs, recomputed(llm, call))  # at temperature 1
    (choice,) = ask(llm, temperature=0, choices=CHOICES).completions
    assert choice.text in CHOICES


def test_choice_is_closed_and_records_what_was_allowed():
    llm = tiny()
    end = llm.chat.end_of_turn
    for seed in range(8):
        call = ask(llm, choices=CHOICES, seed=seed, temperature=1.5)
        (completion,) = call.completions
        assert completion.finish_reason == "choice"
        assert completion.token_ids == (*llm.chat.encode(completion.text), end)
        assert all(t in a for t, a in zip(completion.token_ids, completion.allowed, strict=True))
        forced = [p for p, a in zip(completion.logprobs, completion.allowed, strict=True) if len(a) == 1]
        assert forced == [0.0] * len(forced)
        assert close(completion.logprobs, recomputed(llm, call))
        if completion.text == "go":
            assert completion.allowed[-1] == tuple(sorted((end, *llm.chat.encode(" "))))


def test_choices_are_sampled_by_their_probability():
    # The first branch of these choices is the only one: frequencies against the model's own renormalised numbers.
    llm = tiny()
    texts = ("a", "b", "c")
    call = ask(llm, choices=texts, n=64)
    with torch.no_grad():
        logits = llm.model(torch.tensor([list(call.prompt_ids)])).logits[0, -1]
    expected = logits[[llm.chat.encode(t)[0] for t in texts]].softmax(-1)
    for text, p in zip(texts, expected.tolist(), strict=True):
        count = sum(c.text == text for c in call.completions)
        assert abs(count - 64 * p) < 4 * math.sqrt(64 * p * (1 - p))


def test_single_choice_needs_no_model(monkeypatch):
    llm = tiny(batching="closed")
    monkeypatch.setattr(llm._engine.model, "forward", None)
    monkeypatch.setattr(llm._engine.model, "check", lambda: None)
    (completion,) = ask(llm, choices=("go",)).completions
    assert (completion.text, set(completion.logprobs)) == ("go", {0.0})


def test_forwards_per_choice_are_its_branches(monkeypatch):
    llm = tiny()
    ask(llm, choices=CHOICES)
    forwards = []
    forward = llm._engine.model.forward
    monkeypatch.setattr(
        llm._engine.model, "forward", lambda segments: (forwards.append(segments), forward(segments))[1]
    )
    # "pick up" is decided by its first token, which the prompt's own forward samples.
    for seed in range(20):
        forwards.clear()
        (completion,) = ask(llm, choices=("pick up the order", "wait for it"), seed=seed).completions
        assert len(forwards) == 1, completion


def test_stop_strings_also_across_tokens():
    # Byte tokens: every stop string of two characters crosses a token border.
    llm = tiny()
    free = ask(llm, max_tokens=40, seed=3).completions[0]
    text = free.text
    stop = next(text[i : i + 2] for i in range(4, 30) if text[i : i + 2].isascii() and text.index(text[i : i + 2]) == i)
    (completion,) = ask(llm, max_tokens=40, seed=3, stop=(stop, "never")).completions
    assert completion.text == text[: text.index(stop)]
    assert completion.finish_reason == "stop"
    assert completion.token_ids == free.token_ids[: len(completion.token_ids)]
    assert llm.tokenizer.decode(completion.token_ids).endswith(stop)


def test_end_tokens_stop_and_stay_in_the_ids():
    llm = tiny()
    # Make the end-of-turn token certain.
    llm.model.generation_config.eos_token_id = [llm.tokenizer.eos_token_id, 5]
    other = LocalLLM(llm.model, llm.tokenizer, name="x")
    assert {5, llm.tokenizer.eos_token_id} <= other.stop_ids
    ended = [c for c in ask(other, n=32, max_tokens=60).completions if c.finish_reason == "stop"]
    assert ended
    for completion in ended:
        assert completion.token_ids[-1] in other.stop_ids
        assert not set(completion.token_ids[:-1]) & other.stop_ids
        assert completion.text == llm.tokenizer.decode(completion.token_ids[:-1], skip_special_tokens=True)


def test_top_k_and_top_p_renormalise():
    from agentspec.llm.local.sampling import filter_top

    logprobs = torch.tensor([0.5, 0.1, 0.3, 0.1]).log()
    # Top two of .5, .3: 5/8 and 3/8.
    assert torch.allclose(filter_top(logprobs, 2, 1.0).exp(), torch.tensor([0.625, 0, 0.375, 0]))
    # A nucleus of .6 needs .5 and .3; of .4, the first alone.
    assert torch.allclose(filter_top(logprobs, 0, 0.6).exp(), torch.tensor([0.625, 0, 0.375, 0]))
    assert torch.allclose(filter_top(logprobs, 0, 0.4).exp(), torch.tensor([1.0, 0, 0, 0]))
    # After top-2 (.625, .375) the nucleus of .6 is the first alone.
    assert torch.allclose(filter_top(logprobs, 2, 0.6).exp(), torch.tensor([1.0, 0, 0, 0]))
    llm = tiny()
    (one,) = ask(llm, top_k=1, max_tokens=5).completions
    assert one.token_ids == ask(llm, temperature=0, max_tokens=5).completions[0].token_ids
    assert one.logprobs == (0.0,) * len(one.token_ids)


def test_score_is_the_sum_of_logprobs():
    llm = tiny()
    messages = [system("s"), user("hello")]
    texts = ["yes", "yes please", "no", ""]
    scores = asyncio.run(llm.score(messages, texts))
    prompt = llm.chat.render(messages)
    for text, score in zip(texts, scores, strict=True):
        ids = list(llm.chat.encode(text))
        with torch.no_grad():
            logprobs = llm.model(torch.tensor([prompt + ids])).logits[0].log_softmax(-1)
        expected = sum(float(logprobs[len(prompt) - 1 + i, t]) for i, t in enumerate(ids))
        assert score == pytest.approx(expected, abs=1e-4)
    assert asyncio.run(llm.score(messages, [])) == ()


def test_scores_join_the_batch_of_their_episode():
    llm = tiny()

    async def episode(name):
        llm.enter(name)
        try:
            if name == "a":
                return await llm.score([user("u")], ["x"], episode=name)
            return await llm.generate(request([user("u")], episode=name, max_tokens=2))
        finally:
            llm.leave(name)

    async def main():
        return await asyncio.wait_for(asyncio.gather(episode("a"), episode("b")), 20)

    assert len(asyncio.run(main())) == 2


def test_the_static_prompt_is_computed_once():
    llm = tiny()
    static = "Rules of the house. " * 20
    calls = asyncio.run(_static(llm, static))
    shared = len(llm.chat.encode(static))
    # One of the batch computed it, the other two took it over; so does a later episode.
    assert sorted(c.usage.cached_tokens >= shared for c in calls) == [False, True, True]
    assert ask(llm, system(static), user("late"), max_tokens=1).usage.cached_tokens >= shared


async def _static(llm, static):
    asks = [llm.generate(request([system(static), user(f"{i}?")], id=i, max_tokens=2)) for i in range(3)]
    return await asyncio.gather(*asks)


def test_side_calls_do_not_cost_the_conversation_its_cache():
    llm = tiny()
    long = user("history " * 30)
    first = ask(llm, system("s"), long, episode="e", max_tokens=2)
    ask(llm, system("s"), user("side question"), episode="e", max_tokens=2)
    turn = assistant(Sampled.of(first.completions[0]))
    later = ask(llm, system("s"), long, turn, user("go on"), episode="e", max_tokens=2)
    assert later.usage.cached_tokens >= len(first.prompt_ids)


def test_rebuilt_prompts_keep_one_slot_per_episode():
    llm = tiny()
    for step in range(4):
        for name in "ab":
            call = ask(llm, system("rules " * 20), user(f"state {step} of {name}"), episode=name, max_tokens=2)
    assert call.usage.cached_tokens > 120
    assert len(llm._engine.cache) == 2


def test_changed_weights_drop_the_cache():
    llm = tiny()
    before = ask(llm, max_tokens=4)
    assert ask(llm, max_tokens=4).usage.cached_tokens > 0
    with torch.no_grad():
        for p in llm.model.parameters():
            p.add_(0.02 * torch.randn_like(p))
    after = ask(llm, max_tokens=4)
    assert after.usage.cached_tokens == 0
    assert close(after.completions[0].logprobs, recomputed(llm, after))
    assert after.completions[0].logprobs != before.completions[0].logprobs
    llm.invalidate()
    assert ask(llm, max_tokens=4).usage.cached_tokens == 0


def test_what_is_cached_is_given_back():
    llm = tiny()
    first = ask(llm, max_tokens=4)
    assert len(llm._engine.cache) == 1
    llm.give_back()
    assert len(llm._engine.cache) == 0 and not llm._engine.model._modules._packed
    again = ask(llm, max_tokens=4)
    assert again.usage.cached_tokens == 0 and again.completions == first.completions


def test_a_model_under_training_is_left_as_it_was():
    from peft import LoraConfig, get_peft_model

    tokenizer = tiny_tokenizer()
    base = tiny_model(tokenizer)
    base.gradient_checkpointing_enable()
    model = get_peft_model(base, LoraConfig(target_modules=["q_proj", "v_proj"], lora_dropout=0.5))
    with torch.no_grad():
        for name, p in model.named_parameters():
            if "lora_B" in name:
                p.normal_(std=0.1)
    model.train()
    base.lm_head.eval()  # even a mixed state is restored
    modes = [m.training for m in model.modules()]
    attention = model.config._attn_implementation
    use_cache = model.config.use_cache
    llm = LocalLLM(model, tokenizer, name="peft")
    call = ask(llm, max_tokens=8)
    assert [m.training for m in model.modules()] == modes
    assert (model.config._attn_implementation, model.config.use_cache) == (attention, use_cache)
    assert base.is_gradient_checkpointing
    assert all(p.grad is None for p in model.parameters())
    model.eval()
    assert close(call.completions[0].logprobs, recomputed(llm, call))
    # And it still trains.
    model.train()
    ids = torch.tensor([call.prompt_ids])
    model(ids, labels=ids).loss.backward()
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in model.parameters())


def test_context_overflow_says_what_and_how():
    llm = tiny(max_context=100)
    with pytest.raises(ContextOverflowError, match=r"\d+ tokens.*90.*100"):
        ask(llm, max_tokens=90)
    ask(llm, max_tokens=10)
    # A choice needs the room of the longest choice, whatever max_tokens says.
    ask(llm, choices=CHOICES, max_tokens=90)


def test_only_the_request_at_fault_fails(monkeypatch):
    llm = tiny()
    ask(llm, max_tokens=1)
    forward = llm._engine.model.forward

    def fragile(segments):
        if any(9 in s.tokens for s in segments):
            raise RuntimeError("out of memory")
        return forward(segments)

    monkeypatch.setattr(llm._engine.model, "forward", fragile)

    async def main():
        bad = llm.generate(request([user("u"), assistant(Sampled("x", (9,)))], max_tokens=1))
        good = llm.generate(request([user("u")], id=1, max_tokens=1))
        return await asyncio.gather(bad, good, return_exceptions=True)

    bad, good = asyncio.run(main())
    assert isinstance(bad, LLMError)
    assert "out of memory" in str(bad)
    assert "max_batch" in str(bad)
    assert isinstance(good, LLMCall)


def test_long_prompts_are_read_in_pieces(monkeypatch):
    monkeypatch.setattr("agentspec.llm.local.engine._TOKENS_PER_FORWARD", {"cpu": 16})
    got = converse_all(tiny(), ["a", "bbb", "cc"])
    monkeypatch.undo()
    expected = converse_all(tiny(), ["a", "bbb", "cc"])
    for x, y in zip(got, expected, strict=True):
        assert [c.completions[0].token_ids for c in x] == [c.completions[0].token_ids for c in y]


@needs_smollm2
def test_smollm2_two_turns_with_reuse():
    llm = smollm2()
    llm.invalidate()
    for calls in converse_all(llm, ["a", "bbb", "cccccc"], turns=3, temperature=0.8):
        for call in calls:
            assert close(call.completions[0].logprobs, recomputed(llm, call))
        assert calls[1].usage.cached_tokens >= len(calls[0].prompt_ids)


@needs_smollm2
def test_smollm2_answers():
    call = ask(smollm2(), user("What is the capital of France? Answer in one word."), temperature=0, max_tokens=12)
    assert "Paris" in call.text
    scores = asyncio.run(smollm2().score([user("What is the capital of France?")], ["Paris", "Berlin"]))
    assert scores[0] > scores[1]
