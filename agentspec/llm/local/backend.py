"""The local backend: a live transformers model, possibly the very one under training.

`LocalLLM` turns requests into token rows (`agentspec.llm.chat`), gathers those of all live episodes into one batch
(`agentspec.llm.batching`) and runs it without padding on cached prefixes (`agentspec.llm.local.engine`). The model is
never moved, cast or left changed, so a trainer can give the model it optimises; its weights may change between
batches. Call `LocalLLM.invalidate` after a change: the caches notice writes in place only where torch counts them, and
its fused optimisers (the default of transformers) and writes through `.data` are not counted.
"""

from __future__ import annotations

import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from functools import lru_cache
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal

from agentspec.llm.base import LLMError, Message, Request, require_context
from agentspec.llm.batching import Batcher, Batching
from agentspec.llm.chat import ChatFormat
from agentspec.llm.constrain import ChoiceTrie
from agentspec.llm.local.adapters import UNTAGGED, adapter_for, check_adapters
from agentspec.llm.models import quiet, resolve
from agentspec.types import LLMCall, Sampling, Usage

if TYPE_CHECKING:
    from agentspec.llm.local.engine import Watch
    from agentspec.llm.local.rows import Job
    from agentspec.llm.local.states import StateRecorder


class LocalLLM:
    """An `agentspec.llm.base.LLM` over a transformers causal language model (or a PEFT model around one).

    Args:
        model: the model; used where it is and as it is.
        tokenizer: its Hugging Face tokenizer.
        name: model name in the records.
        max_batch: samples that run at once.
        max_cache_tokens: token positions that the prefix cache and the samples that run at once hold together; one
            costs `2 * layers * key_value_heads * head_size` numbers (SmolLM2-135M in float32: 46 kB, so 3 GB by
            default). Samples beyond it wait; a single one may need more, and so may answers of more than 64 tokens.
        max_context: context window; by default the model's.
        template_kwargs: variables of the chat template, e.g. `{"enable_thinking": False}`.
        patience_s: see `agentspec.llm.batching.Batcher`.
        batching: `"continuous"` or `"closed"` (see `agentspec.llm.batching`). `"auto"` is `"continuous"` where that is
            repeatable to the last bit: where the model's arithmetic is found to be batch-invariant (float32 on a CPU).
            Elsewhere (accelerators, 16-bit floats, mixtures of experts) it is `"closed"`, and a warning says so.
        adapters: which adapter of a PEFT model answers which calls: shell pattern over the call's tag path -> name,
            first match wins (see `agentspec.llm.local.adapters`), e.g.
            `{"reflection.retroformer/*": "reflector", "*": "actor"}`. What matches nothing is answered by the
            adapter that is active.

    Raises:
        ValueError: an unknown `batching`.
        LLMError: the model does not have an adapter named, or its architecture cannot run in this backend (checked
            again, numerically, before the first batch).
    """

    capabilities = frozenset({"token_ids", "logprobs", "choices", "score", "n"})

    def __init__(
        self,
        model: Any,
        tokenizer: Any,
        *,
        name: str,
        max_batch: int = 64,
        max_cache_tokens: int = 65536,
        max_context: int | None = None,
        template_kwargs: Mapping[str, Any] | None = None,
        patience_s: float = 60.0,
        adapters: Mapping[str, str] | None = None,
        batching: Batching | Literal["auto"] = "auto",
    ) -> None:
        from agentspec.llm.local.engine import Engine  # torch; asking what this class takes needs none
        from agentspec.llm.local.forward import PackedModel

        self.name = name
        self.model = model
        self.tokenizer = tokenizer
        self.adapters = dict(adapters or {})
        check_adapters(model, self.adapters)
        self.chat = ChatFormat(tokenizer, template_kwargs)
        packed = PackedModel(model)
        self.max_context = max_context or packed.max_context
        self.stop_ids = self.chat.stop_ids | _eos_ids(model)
        self._engine = Engine(
            packed,
            stop_ids=self.stop_ids,
            decode=self._decode,
            max_batch=max_batch,
            max_cache_tokens=max_cache_tokens,
        )
        self._choose_batching = batching == "auto"
        first: Batching = "closed" if batching == "auto" else batching
        self._batcher: Batcher[Job] = Batcher(self._run, patience_s=patience_s, batching=first)
        self._left: deque[str] = deque()
        self._warned = False
        self._trie = lru_cache(maxsize=512)(self._make_trie)

    @classmethod
    def load(
        cls,
        name_or_path: str | PathLike[str],
        adapter: str | PathLike[str] | None = None,
        *,
        dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto",
        device: str = "auto",
        name: str | None = None,
        **kwargs: Any,
    ) -> LocalLLM:
        """Load a model by folder, bundled name or hub id (see `agentspec.llm.models.resolve`).

        Args:
            name_or_path: which model.
            adapter: a PEFT adapter folder to put on it.
            dtype: `"auto"` (as stored), `"float32"`, `"bfloat16"` or `"float16"`.
            device: `"auto"` (the first accelerator, else the CPU) or a torch device.
            name: model name in the records; by default the one it was found by.
            kwargs: as of `LocalLLM`.

        Raises:
            ModelNotFoundError: no such model or adapter.
            LLMError: its files cannot be loaded.
        """
        import torch
        from transformers import AutoModelForCausalLM, AutoTokenizer

        source = resolve(name_or_path, adapter)
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            with quiet():
                tokenizer = AutoTokenizer.from_pretrained(source.path)
                model = AutoModelForCausalLM.from_pretrained(source.path, dtype=dtype)
            if source.adapter:
                from peft import PeftModel

                model = PeftModel.from_pretrained(model, source.adapter)
            model = model.to(device).eval()
        except (OSError, ValueError, RuntimeError) as error:
            raise LLMError(
                f"the model {source.path} (adapter: {source.adapter}) cannot be loaded: {error}; check that the folder "
                "is complete and was written by `save_pretrained`, and that the device has room for it"
            ) from error
        return cls(model, tokenizer, name=name or source.name, **kwargs)

    async def generate(self, request: Request) -> LLMCall:
        """Sample `request.sampling.n` completions (see `agentspec.llm.base.LLM`)."""
        from agentspec.llm.local.rows import Job

        began = time.perf_counter()
        sampling = request.sampling
        prompt = self.chat.render(request.messages)
        trie = self._trie(sampling.choices) if sampling.choices else None
        require_context(len(prompt), trie.longest if trie else sampling.max_tokens, self.max_context)
        adapter = adapter_for(request.tag.path, self.adapters)
        job = Job(request.tag.episode, prompt, sampling, request.seed, trie, adapter=adapter)
        await self._submit(request.id, job)
        usage = Usage(len(prompt), sum(len(c.token_ids) for c in job.completions), job.cached)
        latency = time.perf_counter() - began
        return LLMCall(request.id, request.tag, tuple(prompt), job.completions, sampling, usage, latency, self.name)

    async def score(
        self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = ""
    ) -> tuple[float, ...]:
        """Log-probability of each continuation after the prompt; what they share is computed once.

        A scoring carries no tag: of `adapters`, only a pattern that matches everything routes it.
        """
        from agentspec.llm.local.rows import Job

        if not continuations:
            return ()
        prompt = self.chat.render(messages)
        encoded = tuple(self.chat.encode(c) for c in continuations)
        require_context(len(prompt), max(map(len, encoded)), self.max_context)
        job = Job(episode, prompt, Sampling(), continuations=encoded, adapter=adapter_for(UNTAGGED, self.adapters))
        await self._submit(-1, job)
        return job.scores

    def watch(self, watch: Watch | None) -> None:
        """Tell `watch` before every forward how far the batch is (see `agentspec.progress.model_progress`)."""
        self._engine.watch = watch

    def count_tokens(self, text: str) -> int:
        """Number of tokens of `text`."""
        return self.chat.count_tokens(text)

    def enter(self, episode: str) -> None:
        """An episode goes live: no batch runs until it, too, waits on the model."""
        self._batcher.enter(episode)

    def leave(self, episode: str) -> None:
        """A live episode ended: the others no longer wait for it."""
        self._left.append(episode)
        self._batcher.leave(episode)

    def invalidate(self) -> None:
        """Drop all cached keys and values, and packed weights: the weights changed.

        Another active adapter, and writes in place that torch counts (not those of fused optimisers), are noticed
        without it.
        """
        self._engine.invalidate()

    def give_back(self) -> None:
        """Drop all that is cached and return its memory to the system: something else needs it now."""
        from agentspec.llm.local.release import release

        self.invalidate()
        release()

    def record_states(self, layer: Any) -> StateRecorder:
        """From now on, what goes into a decoder `layer` of the model is recorded."""
        from agentspec.llm.local.states import StateRecorder

        self._engine.model.recorder = recorder = StateRecorder(layer)
        return recorder

    async def _submit(self, number: int, job: Job) -> None:
        await self._batcher.submit(job.episode, number, job)
        if job.error is not None:
            raise job.error

    def _run(self, jobs: Sequence[Job]) -> None:
        """Run a batch in the worker thread. If it fails, each job runs alone, so that only the one at fault fails."""
        self._release()
        left = {id(job): job for job in jobs}

        def exchange(done: Sequence[Job]) -> Sequence[Job]:
            for job in done:
                del left[id(job)]
            joining = self._batcher.exchange(done)
            if joining:
                self._release()
            left.update((id(job), job) for job in joining)
            return joining

        try:
            if self._choose_batching:
                self._batcher.batching = self._repeatable()
            self._engine.run(jobs, exchange)
        except LLMError:
            raise
        except Exception as error:  # whatever a model raises
            self._engine.cache.clear()
            if len(left) == 1:
                (job,) = left.values()
                job.error = self._failure(job, error)
                return
            for job in left.values():
                self._run_alone(job)

    @property
    def batching(self) -> Batching:
        """How requests are batched; with `"auto"`, decided before the first batch."""
        return self._batcher.batching

    def _repeatable(self) -> Batching:
        """The fastest way of batching that repeats to the last bit; says so when it is not the fastest of all."""
        if self._engine.model.invariant():
            return "continuous"
        if not self._warned:
            self._warned = True
            warnings.warn(
                f"the logits of {self.name} depend, in the last bits, on what shares a forward ({self._arithmetic()}): "
                "batches are closed, so that the run repeats; `batching: continuous` is faster and does not repeat, "
                "and float32 on a CPU does both",
                stacklevel=2,
            )
        return "closed"

    def _arithmetic(self) -> str:
        weight = next(self.model.parameters())
        return f"{type(self.model).__name__}, {str(weight.dtype).removeprefix('torch.')} on {weight.device.type}"

    def _release(self) -> None:
        """Free what ended episodes have cached when others join, not when they happen to end: that hangs on timing."""
        while self._left:
            self._engine.cache.release(self._left.popleft())

    def _run_alone(self, job: Job) -> None:
        try:
            self._engine.run([job])
        except LLMError:
            raise
        except Exception as error:
            self._engine.cache.clear()
            job.error = self._failure(job, error)

    def _failure(self, job: Job, error: Exception) -> LLMError:
        return LLMError(
            f"the model {self.name} failed on a prompt of {len(job.prompt)} tokens: {type(error).__name__}: "
            f"{error}; if it ran out of memory, lower `max_batch`, `max_cache_tokens` or the length of prompts"
        )

    def _decode(self, ids: Sequence[int]) -> str:
        return str(self.tokenizer.decode(ids, skip_special_tokens=True, clean_up_tokenization_spaces=False))

    def _make_trie(self, choices: tuple[str, ...]) -> ChoiceTrie:
        if self.chat.end_of_turn is None:
            raise LLMError(
                f"the tokenizer of {self.name} has no end-of-turn token to close a choice with; set its `eos_token`"
            )
        return ChoiceTrie([self.chat.encode(c) for c in choices], self.chat.end_of_turn)


def _eos_ids(model: Any) -> frozenset[int]:
    """All end-of-sequence ids of the model's generation config."""
    eos = getattr(getattr(model, "generation_config", None), "eos_token_id", None)
    if eos is None:
        return frozenset()
    return frozenset(eos if isinstance(eos, list | tuple) else [eos])
