"""vLLM on a GPU machine, through the engine that TRL keeps in step with the policy.

TRL starts vLLM (colocated, or as a server), and pushes the trainer's weights into it. This backend sends it the
scaffold's prompts as token ids, each request with its own sampling parameters and seed, as episodes ask, and takes back
tokens and log-probabilities as they are finished: vLLM writes for many at once, and nobody waits for anybody else's
answer. The log-probabilities are those after temperature (``processed_logprobs``). Constrained choices are not offered:
vLLM's grammar may spell a text in other tokens than ours, and the record of what was allowed would be wrong; use native
actions.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from agentspec.llm.base import LLMError, Message, Request, require_context
from agentspec.llm.batching import Batcher
from agentspec.llm.chat import chat_format
from agentspec.types import Completion, LLMCall, Sampling, Usage

REQUESTS = 64
"""Most requests to a server at once: as many connections as TRL's client keeps."""


@dataclass(frozen=True)
class Sampled:
    """What an engine returns of one sample: ids, log-probability of each, and why it ended."""

    token_ids: tuple[int, ...]
    logprobs: tuple[float, ...]
    finish_reason: str


@dataclass(eq=False)
class Job:
    """A prompt and how to continue it; ``samples`` is filled in."""

    prompt: tuple[int, ...]
    sampling: Sampling
    seed: int
    samples: list[Sampled] = field(default_factory=list)


class Engine(Protocol):
    """What runs jobs. ``enter`` and ``leave`` tell it which episodes are live."""

    async def sample(self, episode: str, number: int, job: Job) -> None:
        """Fill in ``job.samples``, ``sampling.n`` of them."""

    def enter(self, episode: str) -> None: ...

    def leave(self, episode: str) -> None: ...


class VLLMBackend:
    """An :class:`~agentspec.llm.base.LLM` over a vLLM engine.

    Args:
        engine: see :class:`Engine`; :func:`trl_backend` makes one of TRL's.
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

    async def generate(self, request: Request) -> LLMCall:
        """Sample from vLLM (see :class:`~agentspec.llm.base.LLM`)."""
        if request.sampling.choices:
            raise LLMError("the vLLM backend does not constrain answers to choices; set `action_mode: native`")
        start = time.perf_counter()
        prompt = tuple(self._format.render(request.messages))
        require_context(len(prompt), request.sampling.max_tokens, self.max_context)
        # Greedy samples are all the same, and vLLM refuses to draw several.
        greedy = request.sampling.temperature == 0
        job = Job(prompt, replace(request.sampling, n=1) if greedy else request.sampling, request.seed)
        await self._engine.sample(request.tag.episode, request.id, job)
        samples = job.samples * request.sampling.n if greedy else job.samples
        completions = tuple(self._completion(s, request.sampling) for s in samples)
        usage = Usage(len(prompt), sum(len(c.token_ids) for c in completions))
        latency = time.perf_counter() - start
        return LLMCall(request.id, request.tag, prompt, completions, request.sampling, usage, latency, self.name)

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
        self._engine.enter(episode)

    def leave(self, episode: str) -> None:
        self._engine.leave(episode)


def trl_backend(generation: Any, tokenizer: Any) -> VLLMBackend:
    """The backend over TRL's ``VLLMGeneration``, in either of its modes.

    With a server, TRL gives only the main process a client, which also pushes the weights; the other processes ask
    through clients of their own.

    Raises:
        LLMError: the server reports log-probabilities that are not those it samples from.
    """
    if generation.mode == "colocate":
        limit = generation.llm.llm_engine.model_config.max_model_len
        return VLLMBackend(Colocated(generation), tokenizer, max_context=limit)
    client = getattr(generation, "vllm_client", None) or _client(generation)
    model = client.get_server_info()["model_config"]
    if model["logprobs_mode"] != "processed_logprobs":
        raise LLMError(
            f"the vLLM server runs with --logprobs-mode {model['logprobs_mode']}: its log-probabilities are not those "
            "it samples from; start it with --logprobs-mode processed_logprobs"
        )
    return VLLMBackend(Server(client), tokenizer, max_context=model["max_model_len"])


def _client(generation: Any) -> Any:
    """A client that only asks: it takes no part in pushing weights."""
    from trl.generation.vllm_client import VLLMClient

    url = generation.server_base_url or f"http://{generation.server_host}:{generation.server_port}"
    return VLLMClient(base_url=url, connection_timeout=generation.server_timeout)


class Colocated:
    """The engine inside this process (``vllm_mode: colocate``), of TRL's ``VLLMGeneration``.

    Requests join and leave between two of its steps (`agentspec.llm.batching`, `continuous`).
    """

    def __init__(self, generation: Any) -> None:
        self._generation = generation
        self._batcher: Batcher[Job] = Batcher(self._run, batching="continuous")
        self._names = map("scaffold-{}".format, itertools.count())

    async def sample(self, episode: str, number: int, job: Job) -> None:
        """See :class:`Engine`."""
        await self._batcher.submit(episode, number, job)

    def enter(self, episode: str) -> None:
        """See :class:`Engine`."""
        self._batcher.enter(episode)

    def leave(self, episode: str) -> None:
        """See :class:`Engine`."""
        self._batcher.leave(episode)

    def _run(self, jobs: Sequence[Job]) -> None:
        import torch

        device = self._generation.accelerator.device
        if device.type == "cuda":
            torch.cuda.set_device(device)  # a property of the thread, and this is not the trainer's
        engine = self._generation.llm.llm_engine
        running: dict[str, Job] = {}
        joining = jobs
        try:
            while joining or running:
                for job in joining:
                    name = next(self._names)
                    running[name] = job
                    engine.add_request(name, {"prompt_token_ids": list(job.prompt)}, _parameters(job))
                done = []
                for output in engine.step():
                    if output.finished:
                        job = running.pop(output.request_id)
                        job.samples = [_from_output(sample) for sample in output.outputs]
                        done.append(job)
                joining = self._batcher.exchange(done)
        finally:
            if running:
                engine.abort_request(list(running))


def _parameters(job: Job) -> Any:
    from vllm import SamplingParams
    from vllm.sampling_params import RequestOutputKind

    s = job.sampling
    return SamplingParams(
        n=s.n,
        temperature=s.temperature,
        top_p=s.top_p,
        top_k=s.top_k,
        max_tokens=s.max_tokens,
        stop=list(s.stop),
        include_stop_str_in_output=True,
        seed=job.seed % 2**31,
        logprobs=0,
        output_kind=RequestOutputKind.FINAL_ONLY,
    )


def _from_output(sample: Any) -> Sampled:
    ids = tuple(sample.token_ids)
    logprobs = tuple(float(entry[token].logprob) for token, entry in zip(ids, sample.logprobs, strict=True))
    return Sampled(ids, logprobs, "length" if sample.finish_reason == "length" else "stop")


class Server:
    """TRL's vLLM server (``vllm_mode: server``): one request per prompt, as episodes ask, each with its own seed."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._threads = ThreadPoolExecutor(REQUESTS, thread_name_prefix="agentspec-vllm")

    async def sample(self, episode: str, number: int, job: Job) -> None:
        """See :class:`Engine`."""
        await asyncio.get_running_loop().run_in_executor(self._threads, self._ask, job)

    def enter(self, episode: str) -> None:
        """The server need not know."""

    def leave(self, episode: str) -> None:
        """The server need not know."""

    def _ask(self, job: Job) -> None:
        s = job.sampling
        output = self._client.generate(
            [list(job.prompt)],
            n=s.n,
            temperature=s.temperature,
            top_p=s.top_p,
            top_k=s.top_k,
            max_tokens=s.max_tokens,
            logprobs=0,
            generation_kwargs={
                "stop": list(s.stop),
                "include_stop_str_in_output": True,
                "seed": job.seed % 2**31,
            },
        )
        parts = (output[name] for name in ("completion_ids", "logprob_token_ids", "logprobs"))
        for ids, tokens, logprobs in zip(*parts, strict=True):
            own = (v[t.index(i)] for i, t, v in zip(ids, tokens, logprobs, strict=True))
            reason = "length" if len(ids) >= s.max_tokens else "stop"
            job.samples.append(Sampled(tuple(ids), tuple(map(float, own)), reason))
