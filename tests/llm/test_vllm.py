"""The vLLM backend against fake engines: what it sends, what it records, what it refuses.

vLLM itself: ``tests/trainers/test_real_vllm.py``.
"""

from __future__ import annotations

import asyncio
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("transformers")

from agentspec.llm.base import ContextOverflowError, LLMError, Request, system, user
from agentspec.llm.vllm import Colocated, Job, Sampled, Server, VLLMBackend, trl_backend
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
        self.asked: list[Job] = []
        self.live: list[str] = []

    async def sample(self, episode: str, number: int, job: Job) -> None:
        self.asked.append(job)
        sample = Sampled(self.ids, tuple(-0.1 * i for i in range(len(self.ids))), "stop")
        job.samples = [sample] * job.sampling.n

    def enter(self, episode: str) -> None:
        self.live.append(episode)

    def leave(self, episode: str) -> None:
        self.live.remove(episode)


def backend(engine: Any, tokenizer: Any, **settings: Any) -> VLLMBackend:
    return VLLMBackend(engine, tokenizer, max_context=settings.pop("max_context", 1000), **settings)


def test_tokens_and_log_probabilities_are_recorded_as_sampled() -> None:
    tokenizer = tiny_tokenizer()
    engine = FakeEngine(tokenizer)
    call = asyncio.run(backend(engine, tokenizer).generate(request("the price is 3", n=2)))
    (job,) = engine.asked
    assert call.prompt_ids == job.prompt and job.seed == 100 and job.sampling.n == 2
    assert "the price is 3" in tokenizer.decode(call.prompt_ids)
    assert len(call.completions) == 2
    for completion in call.completions:
        assert completion.token_ids == engine.ids and completion.text == "SELL()"
        assert completion.logprobs == pytest.approx([-0.1 * i for i in range(len(engine.ids))])
        assert completion.allowed == () and completion.finish_reason == "stop"
    assert call.usage.input_tokens == len(call.prompt_ids) and call.usage.output_tokens == 2 * len(engine.ids)


def test_greedy_samples_are_drawn_once() -> None:
    tokenizer = tiny_tokenizer()
    engine = FakeEngine(tokenizer)
    call = asyncio.run(backend(engine, tokenizer).generate(request("x", n=3, temperature=0.0)))
    assert [job.sampling.n for job in engine.asked] == [1]  # vLLM refuses more
    assert len(call.completions) == 3 and len(set(call.completions)) == 1 and call.sampling.n == 3


def test_the_engine_knows_who_is_live() -> None:
    tokenizer = tiny_tokenizer()
    engine = FakeEngine(tokenizer)
    llm = backend(engine, tokenizer)
    llm.enter("a")
    assert engine.live == ["a"]
    llm.leave("a")
    assert engine.live == []


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


# --- TRL's engines ---------------------------------------------------------------------------------------------------


def fake_vllm(monkeypatch: pytest.MonkeyPatch) -> None:
    module, sampling = ModuleType("vllm"), ModuleType("vllm.sampling_params")
    module.SamplingParams = lambda **fields: SimpleNamespace(**fields)  # type: ignore[attr-defined]
    sampling.RequestOutputKind = SimpleNamespace(FINAL_ONLY="final")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "vllm", module)
    monkeypatch.setitem(sys.modules, "vllm.sampling_params", sampling)


class FakeVLLM:
    """vLLM's engine as far as it is used: a step writes one more token (7, 8, 7, ...) of each, with a log-probability.

    It finishes after ``max_tokens``, and keeps who was in each step.
    """

    def __init__(self, finish_reason: str = "stop", fails_at: int = -1) -> None:
        self.asked: list[tuple[Any, Any]] = []
        self.steps: list[list[int]] = []
        self.left: dict[str, tuple[list[int], Any, int]] = {}
        self.finish_reason, self.fails_at = finish_reason, fails_at

    def add_request(self, name: str, prompt: Any, parameters: Any) -> None:
        assert name not in self.left
        self.asked.append((prompt, parameters))
        self.left[name] = (prompt["prompt_token_ids"], parameters, 0)

    def abort_request(self, names: list[str]) -> None:
        for name in names:
            del self.left[name]

    def step(self) -> list[Any]:
        self.steps.append(sorted(prompt[0] for prompt, _, _ in self.left.values()))
        if len(self.steps) == self.fails_at:
            raise RuntimeError("out of memory")
        outputs = []
        for name, (prompt, parameters, n) in list(self.left.items()):
            self.left[name] = (prompt, parameters, n + 1)
            finished = n + 1 == parameters.max_tokens
            ids = [7 + i % 2 for i in range(n + 1)]
            likelier = SimpleNamespace(logprob=-0.1)
            logprobs = [{i: SimpleNamespace(logprob=-0.5 * (i - 6)), 9: likelier} for i in ids]
            sample = SimpleNamespace(token_ids=ids, logprobs=logprobs, finish_reason=self.finish_reason)
            outputs.append(SimpleNamespace(request_id=name, finished=finished, outputs=[sample] * parameters.n))
            if finished:
                del self.left[name]
        return outputs


def colocated(engine: FakeVLLM) -> Colocated:
    device = SimpleNamespace(type="cpu")
    return Colocated(
        SimpleNamespace(llm=SimpleNamespace(llm_engine=engine), accelerator=SimpleNamespace(device=device))
    )


def sampled(engine: Any, *jobs: Job) -> None:
    async def main() -> None:
        await asyncio.gather(*[engine.sample("", i, job) for i, job in enumerate(jobs)])

    asyncio.run(main())


@pytest.mark.parametrize("reason", ["stop", "length"])
def test_colocated(monkeypatch: pytest.MonkeyPatch, reason: str) -> None:
    fake_vllm(monkeypatch)
    engine = FakeVLLM(reason)
    one = Job((1, 2), Sampling(temperature=0.7, max_tokens=2, stop=("\n",)), 5)
    two = Job((3,), Sampling(top_p=0.9, top_k=20, n=2, max_tokens=1), 2**31 + 6)
    sampled(colocated(engine), one, two)
    # Each sampled token has its own log-probability, not that of a likelier one.
    assert one.samples == [Sampled((7, 8), (-0.5, -1.0), reason)]
    assert two.samples == [Sampled((7,), (-0.5,), reason)] * 2
    (prompt, first), (other, second) = engine.asked
    assert (prompt, other) == ({"prompt_token_ids": [1, 2]}, {"prompt_token_ids": [3]})
    assert (first.temperature, first.max_tokens, first.stop, first.n, first.seed) == (0.7, 2, ["\n"], 1, 5)
    assert (second.top_p, second.top_k, second.n, second.seed) == (0.9, 20, 2, 6)
    # The stop string's tokens were sampled: they stay in the record.
    assert all(p.include_stop_str_in_output and p.logprobs == 0 for p in (first, second))
    assert {p.output_kind for p in (first, second)} == {"final"}


def test_a_short_answer_does_not_wait_for_a_long_one(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_vllm(monkeypatch)
    engine = FakeVLLM()
    run = colocated(engine)

    async def episode(name: str, token: int, lengths: list[int]) -> None:
        run.enter(name)
        for turn, n in enumerate(lengths):
            await run.sample(name, turn, Job((token,), Sampling(max_tokens=n), 0))
        run.leave(name)

    async def main() -> None:
        await asyncio.gather(episode("a", 1, [2, 2, 2]), episode("b", 2, [6]))

    asyncio.run(main())
    assert engine.steps == [[1, 2]] * 6


def test_an_engine_that_fails_fails_its_requests_and_none_stays_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_vllm(monkeypatch)
    engine = FakeVLLM(fails_at=2)
    run = colocated(engine)
    with pytest.raises(RuntimeError, match="out of memory"):
        sampled(run, Job((1,), Sampling(max_tokens=3), 0), Job((2,), Sampling(max_tokens=9), 0))
    assert engine.left == {}
    again = Job((3,), Sampling(max_tokens=1), 0)
    sampled(run, again)
    assert engine.steps[-1] == [3] and len(again.samples) == 1


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
    jobs = Job((1,), short, 10), Job((2,), pair, 11), Job((3,), short, 2**31 + 12)
    sampled(Server(client), *jobs)
    # Every prompt has its own answer, from its own seed.
    assert [[s.token_ids for s in job.samples] for job in jobs] == [[(1, 10)], [(2, 11), (2, 11)], [(3, 12)]]
    assert jobs[0].samples[0].finish_reason == "length" and jobs[1].samples[0].finish_reason == "stop"
    assert jobs[1].samples[0].logprobs == (-0.25, -0.5)  # the sampled token's, not the likelier one's
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
