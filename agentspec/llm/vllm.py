"""vLLM on a GPU machine, through the engine that TRL keeps in step with the policy.

TRL starts vLLM (colocated, or as a server), and pushes the trainer's weights into it. This backend sends it the
scaffold's prompts as token ids, all live episodes at once, with each request's own sampling parameters and seed, and
takes back tokens and log-probabilities. The log-probabilities are those after temperature (``processed_logprobs``).
Constrained choices are not offered: vLLM's grammar may spell a text in other tokens than ours, and the record of what
was allowed would be wrong; use native actions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from agentspec.llm.base import LLMError, Message, Request, require_context
from agentspec.llm.batching import Batcher
from agentspec.llm.chat import chat_format
from agentspec.types import Completion, LLMCall, Sampling, Usage


@dataclass(frozen=True)
class Sampled:
    """What an engine returns of one sample: ids, log-probability of each, and why it ended."""

    token_ids: tuple[int, ...]
    logprobs: tuple[float, ...]
    finish_reason: str


REQUESTS = 64
"""Most requests to a server at once: as many connections as TRL's client keeps."""

Engine = Callable[[Sequence[Sequence[int]], Sequence[Sampling], Sequence[int]], list[list[Sampled]]]
"""prompts, sampling parameters and seeds, one each -> samples of each prompt."""


@dataclass
class _Job:
    prompt: tuple[int, ...]
    sampling: Sampling
    seed: int
    samples: list[Sampled] = field(default_factory=list)


class VLLMBackend:
    """An :class:`~agentspec.llm.base.LLM` over a vLLM engine.

    Args:
        engine: see :data:`Engine`; :func:`trl_backend` makes one of TRL's.
        tokenizer: the policy's.
        max_context: longest prompt plus answer.
    """

    capabilities = frozenset({"token_ids", "logprobs", "n"})

    def __init__(self, engine: Engine, tokenizer: Any, *, max_context: int, name: str = "policy") -> None:
        self.name = name
        self.max_context = max_context
        self._engine = engine
        self._tokenizer = tokenizer
        self._format = chat_format(tokenizer)
        self._batcher: Batcher[_Job] = Batcher(self._run)

    async def generate(self, request: Request) -> LLMCall:
        """Sample from vLLM (see :class:`~agentspec.llm.base.LLM`)."""
        if request.sampling.choices:
            raise LLMError("the vLLM backend does not constrain answers to choices; set `action_mode: native`")
        start = time.perf_counter()
        prompt = tuple(self._format.render(request.messages))
        require_context(len(prompt), request.sampling.max_tokens, self.max_context)
        job = _Job(prompt, request.sampling, request.seed)
        await self._batcher.submit(request.tag.episode, request.id, job)
        completions = tuple(self._completion(s, request.sampling) for s in job.samples)
        usage = Usage(len(prompt), sum(len(c.token_ids) for c in completions))
        latency = time.perf_counter() - start
        return LLMCall(request.id, request.tag, prompt, completions, request.sampling, usage, latency, self.name)

    def _run(self, jobs: Sequence[_Job]) -> None:
        results = self._engine([j.prompt for j in jobs], [j.sampling for j in jobs], [j.seed for j in jobs])
        for job, samples in zip(jobs, results, strict=True):
            job.samples = samples

    def _completion(self, sample: Sampled, sampling: Sampling) -> Completion:
        """Text cut at the first stop string; the tokens stay as they were sampled."""
        text = self._tokenizer.decode([t for t in sample.token_ids if t not in self._format.stop_ids])
        cuts = [text.find(stop) for stop in sampling.stop if stop in text]
        return Completion(
            text[: min(cuts)] if cuts else text, sample.token_ids, sample.logprobs, finish_reason=sample.finish_reason
        )

    async def score(self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = "") -> Any:
        """Refused: scoring goes through the local backend."""
        raise LLMError("the vLLM backend does not score continuations; use the local backend for this method")

    def count_tokens(self, text: str) -> int:
        return self._format.count_tokens(text)

    def enter(self, episode: str) -> None:
        self._batcher.enter(episode)

    def leave(self, episode: str) -> None:
        self._batcher.leave(episode)


def trl_backend(generation: Any, tokenizer: Any) -> VLLMBackend:
    """The backend over TRL's ``VLLMGeneration``, in either of its modes.

    With a server, TRL gives only the main process a client, which also pushes the weights; the other processes ask
    through clients of their own.

    Raises:
        LLMError: the server reports log-probabilities that are not those it samples from.
    """
    if generation.mode == "colocate":
        limit = generation.llm.llm_engine.model_config.max_model_len
        return VLLMBackend(colocated(generation), tokenizer, max_context=limit)
    client = getattr(generation, "vllm_client", None) or _client(generation)
    model = client.get_server_info()["model_config"]
    if model["logprobs_mode"] != "processed_logprobs":
        raise LLMError(
            f"the vLLM server runs with --logprobs-mode {model['logprobs_mode']}: its log-probabilities are not those "
            "it samples from; start it with --logprobs-mode processed_logprobs"
        )
    return VLLMBackend(server(client), tokenizer, max_context=model["max_model_len"])


def _client(generation: Any) -> Any:
    """A client that only asks: it takes no part in pushing weights."""
    from trl.generation.vllm_client import VLLMClient

    url = generation.server_base_url or f"http://{generation.server_host}:{generation.server_port}"
    return VLLMClient(base_url=url, connection_timeout=generation.server_timeout)


def colocated(generation: Any) -> Engine:
    """The engine inside this process (``vllm_mode: colocate``), of TRL's ``VLLMGeneration``."""

    def run(
        prompts: Sequence[Sequence[int]], sampling: Sequence[Sampling], seeds: Sequence[int]
    ) -> list[list[Sampled]]:
        import torch
        from vllm import SamplingParams

        device = generation.accelerator.device
        if device.type == "cuda":
            torch.cuda.set_device(device)  # a property of the thread, and this is not the trainer's
        parameters = [
            SamplingParams(
                n=s.n,
                temperature=s.temperature,
                top_p=s.top_p,
                top_k=s.top_k,
                max_tokens=s.max_tokens,
                stop=list(s.stop),
                include_stop_str_in_output=True,
                seed=seed % 2**31,
                logprobs=0,
            )
            for s, seed in zip(sampling, seeds, strict=True)
        ]
        inputs = [{"prompt_token_ids": list(p)} for p in prompts]
        outputs = generation.llm.generate(inputs, sampling_params=parameters, use_tqdm=False)
        return [[_from_output(sample) for sample in output.outputs] for output in outputs]

    return run


def _from_output(sample: Any) -> Sampled:
    ids = tuple(sample.token_ids)
    logprobs = tuple(float(entry[token].logprob) for token, entry in zip(ids, sample.logprobs, strict=True))
    return Sampled(ids, logprobs, "length" if sample.finish_reason == "length" else "stop")


def server(client: Any) -> Engine:
    """TRL's vLLM server (``vllm_mode: server``): one request per prompt, all at once, each with its own seed."""

    def ask(prompt: Sequence[int], sampling: Sampling, seed: int) -> list[Sampled]:
        output = client.generate(
            [list(prompt)],
            n=sampling.n,
            temperature=sampling.temperature,
            top_p=sampling.top_p,
            top_k=sampling.top_k,
            max_tokens=sampling.max_tokens,
            logprobs=0,
            generation_kwargs={
                "stop": list(sampling.stop),
                "include_stop_str_in_output": True,
                "seed": seed % 2**31,
            },
        )
        samples = []
        parts = (output[name] for name in ("completion_ids", "logprob_token_ids", "logprobs"))
        for ids, tokens, logprobs in zip(*parts, strict=True):
            own = (v[t.index(i)] for i, t, v in zip(ids, tokens, logprobs, strict=True))
            reason = "length" if len(ids) >= sampling.max_tokens else "stop"
            samples.append(Sampled(tuple(ids), tuple(map(float, own)), reason))
        return samples

    def run(
        prompts: Sequence[Sequence[int]], sampling: Sequence[Sampling], seeds: Sequence[int]
    ) -> list[list[Sampled]]:
        with ThreadPoolExecutor(min(len(prompts), REQUESTS)) as pool:
            return list(pool.map(ask, prompts, sampling, seeds))

    return run
