"""The vLLM backend against fake engines: what it sends, what it records, what it refuses."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Sequence
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("transformers")

from agentspec.llm.base import ContextOverflowError, LLMError, Request, system, user
from agentspec.llm.vllm import Sampled, VLLMBackend, colocated, server, trl_backend
from agentspec.types import CallTag, Sampling
from tests.tiny import tiny_tokenizer


def request(text: str, episode: str = "a", number: int = 0, **sampling: Any) -> Request:
    tag = CallTag("reasoning.direct", "act", episode, 0)
    sampled = Sampling(**{"max_tokens": 16, **sampling})
    return Request((system("s"), user(text)), sampled, tag, seed=100 + number, id=number)


class FakeEngine:
    """Answers ``answer`` to everything; keeps what it was asked."""

    def __init__(self, tokenizer: Any, answer: str = "SELL()") -> None:
        self.ids = (*tokenizer.encode(answer), tokenizer.eos_token_id)
        self.batches: list[tuple[Any, Any, Any]] = []

    def __call__(
        self, prompts: Sequence[Sequence[int]], sampling: Sequence[Sampling], seeds: Sequence[int]
    ) -> list[list[Sampled]]:
        self.batches.append((list(prompts), list(sampling), list(seeds)))
        sample = Sampled(self.ids, tuple(-0.1 * i for i in range(len(self.ids))), "stop")
        return [[sample] * s.n for s in sampling]


def backend(engine: Any, tokenizer: Any, **settings: Any) -> VLLMBackend:
    return VLLMBackend(engine, tokenizer, max_context=settings.pop("max_context", 1000), **settings)


def test_tokens_and_log_probabilities_are_recorded_as_sampled() -> None:
    tokenizer = tiny_tokenizer()
    engine = FakeEngine(tokenizer)
    call = asyncio.run(backend(engine, tokenizer).generate(request("the price is 3", n=2)))
    ((prompts, sampling, seeds),) = engine.batches
    assert call.prompt_ids == tuple(prompts[0]) and seeds == [100] and sampling[0].n == 2
    assert "the price is 3" in tokenizer.decode(call.prompt_ids)
    assert len(call.completions) == 2
    for completion in call.completions:
        assert completion.token_ids == engine.ids and completion.text == "SELL()"
        assert completion.logprobs == pytest.approx([-0.1 * i for i in range(len(engine.ids))])
        assert completion.allowed == () and completion.finish_reason == "stop"
    assert call.usage.input_tokens == len(call.prompt_ids) and call.usage.output_tokens == 2 * len(engine.ids)


def test_all_live_episodes_go_in_one_batch_in_order() -> None:
    tokenizer = tiny_tokenizer()
    engine = FakeEngine(tokenizer)
    llm = backend(engine, tokenizer)

    async def episode(name: str, delay: float) -> None:
        llm.enter(name)
        for turn in range(2):
            await asyncio.sleep(delay)
            await llm.generate(request(f"{name} {turn}", name, turn))
        llm.leave(name)

    async def play() -> None:
        await asyncio.gather(episode("c", 0.0), episode("a", 0.02), episode("b", 0.01))

    asyncio.run(play())
    asked = [[tokenizer.decode(p) for p in prompts] for prompts, _, _ in engine.batches]
    assert [len(batch) for batch in asked] == [3, 3]
    for turn, batch in enumerate(asked):
        assert all(f"{name} {turn}" in text for name, text in zip("abc", batch, strict=True))


def test_a_stop_string_is_cut_from_the_text_and_not_from_the_tokens() -> None:
    tokenizer = tiny_tokenizer()
    engine = FakeEngine(tokenizer, "SELL()\nObservation: made up")
    call = asyncio.run(backend(engine, tokenizer).generate(request("x", stop=("Observation:", "\n"))))
    assert call.text == "SELL()"  # the first stop string that occurs
    assert call.completions[0].token_ids == engine.ids


def test_what_vllm_does_not_do_is_refused() -> None:
    tokenizer = tiny_tokenizer()
    llm = backend(FakeEngine(tokenizer), tokenizer, max_context=60)
    with pytest.raises(LLMError, match="action_mode: native"):
        asyncio.run(llm.generate(request("x", choices=("a", "b"))))
    with pytest.raises(LLMError, match="does not score"):
        asyncio.run(llm.score((user("x"),), ("a",)))
    with pytest.raises(ContextOverflowError, match="context is 60"):
        asyncio.run(llm.generate(request("x" * 100)))
    assert "choices" not in llm.capabilities and "score" not in llm.capabilities
    assert llm.count_tokens("abc") == 3


def test_an_engine_that_fails_fails_its_requests() -> None:
    tokenizer = tiny_tokenizer()

    def broken(*_: Any) -> Any:
        raise RuntimeError("out of memory")

    with pytest.raises(RuntimeError, match="out of memory"):
        asyncio.run(backend(broken, tokenizer).generate(request("x")))


# --- TRL's engines ---------------------------------------------------------------------------------------------------


def fake_vllm(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("vllm")
    module.SamplingParams = lambda **fields: SimpleNamespace(**fields)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "vllm", module)


class FakeVLLM:
    """``vllm.LLM`` as far as it is used: samples 7, 8 and reports a log-probability of each."""

    def __init__(self, finish_reason: str = "stop") -> None:
        self.asked: list[tuple[Any, Any]] = []
        self.finish_reason = finish_reason

    def generate(self, inputs: Any, *, sampling_params: Any, use_tqdm: bool) -> Any:
        assert use_tqdm is False
        self.asked.append((inputs, sampling_params))
        entry = [{7: SimpleNamespace(logprob=-0.5), 9: SimpleNamespace(logprob=-0.1)}, {8: SimpleNamespace(logprob=-1)}]
        sample = SimpleNamespace(token_ids=[7, 8], logprobs=entry, finish_reason=self.finish_reason)
        return [SimpleNamespace(outputs=[sample] * p.n) for p in sampling_params]


@pytest.mark.parametrize("reason", ["stop", "length"])
def test_colocated(monkeypatch: pytest.MonkeyPatch, reason: str) -> None:
    fake_vllm(monkeypatch)
    llm = FakeVLLM(reason)
    run = colocated(SimpleNamespace(llm=llm, accelerator=SimpleNamespace(device=SimpleNamespace(type="cpu"))))
    kinds = [Sampling(temperature=0.7, max_tokens=5, stop=("\n",)), Sampling(top_p=0.9, top_k=20, n=2)]
    got = run([(1, 2), (3,)], kinds, [5, 2**31 + 6])
    # Each sampled token has its own log-probability, not that of a likelier one; one list per prompt.
    assert got == [[Sampled((7, 8), (-0.5, -1.0), reason)], [Sampled((7, 8), (-0.5, -1.0), reason)] * 2]
    ((inputs, parameters),) = llm.asked
    assert inputs == [{"prompt_token_ids": [1, 2]}, {"prompt_token_ids": [3]}]
    first, second = parameters
    assert (first.temperature, first.max_tokens, first.stop, first.n, first.seed) == (0.7, 5, ["\n"], 1, 5)
    assert (second.top_p, second.top_k, second.n, second.seed) == (0.9, 20, 2, 6)
    # The stop string's tokens were sampled: they stay in the record.
    assert all(p.include_stop_str_in_output and p.logprobs == 0 for p in parameters)


class Client:
    """TRL's client: answers the first token of the prompt and its seed, a likelier token beside each."""

    def __init__(self, logprobs_mode: str = "processed_logprobs") -> None:
        self.asked: list[tuple[Any, dict[str, Any]]] = []
        self.logprobs_mode = logprobs_mode

    def get_server_info(self) -> Any:
        return {"model_config": {"logprobs_mode": self.logprobs_mode, "max_model_len": 77}}

    def generate(self, prompts: Any, **fields: Any) -> Any:
        self.asked.append((prompts, fields))
        ids = [prompts[0][0], fields["generation_kwargs"]["seed"]]
        return {
            "completion_ids": [ids] * fields["n"],
            "logprobs": [[[-0.1, -0.25], [-0.5]]] * fields["n"],
            "logprob_token_ids": [[[99, ids[0]], [ids[1]]]] * fields["n"],
        }


def test_server() -> None:
    client = Client()
    short, pair = Sampling(max_tokens=2, stop=("\n",)), Sampling(max_tokens=9, n=2)
    got = server(client)([(1,), (2,), (3,)], [short, pair, short], [10, 11, 2**31 + 12])
    # The answers come back in the order of the prompts, each from its own seed.
    assert [[s.token_ids for s in samples] for samples in got] == [[(1, 10)], [(2, 11), (2, 11)], [(3, 12)]]
    assert got[0][0].finish_reason == "length" and got[1][0].finish_reason == "stop"
    assert got[1][0].logprobs == (-0.25, -0.5)  # the sampled token's, not the likelier one's
    ((prompts, fields),) = [asked for asked in client.asked if asked[0] == [[1]]]
    assert prompts == [[1]] and (fields["n"], fields["max_tokens"], fields["logprobs"]) == (1, 2, 0)
    assert fields["generation_kwargs"] == {"stop": ["\n"], "include_stop_str_in_output": True, "seed": 10}


def test_the_backend_of_trl_s_server(monkeypatch: pytest.MonkeyPatch) -> None:
    client = Client()
    backend = trl_backend(SimpleNamespace(mode="server", vllm_client=client), tiny_tokenizer())
    assert backend.max_context == 77  # the server's own limit
    # Processes other than the main one have no client from TRL.
    monkeypatch.setattr("trl.generation.vllm_client.VLLMClient", lambda **fields: asked.append(fields) or client)
    asked: list[dict[str, Any]] = []
    other = SimpleNamespace(
        mode="server", server_base_url=None, server_host="host", server_port=8000, server_timeout=3.0
    )
    assert trl_backend(other, tiny_tokenizer()).max_context == 77
    assert asked == [{"base_url": "http://host:8000", "connection_timeout": 3.0}]
    with pytest.raises(LLMError, match="--logprobs-mode raw_logprobs"):
        trl_backend(SimpleNamespace(mode="server", vllm_client=Client("raw_logprobs")), tiny_tokenizer())
