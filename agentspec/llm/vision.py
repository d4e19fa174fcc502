"""A vision-language model of transformers, for evaluation: its own processor, `generate`, one request at a time.

The processor writes the prompt: its chat template places the pictures, and what a model wrote earlier is encoded again
as text. Records hold token ids but no log-probabilities, so episodes can be measured, not trained on.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Literal

from agentspec.llm.base import LLMError, Message, Request, require_context
from agentspec.llm.constrain import ChoiceTrie
from agentspec.llm.models import quiet, resolve
from agentspec.llm.pictures import LARGEST, fitted, opened, pictures_of
from agentspec.types import Completion, LLMCall, Picture, Sampling, Usage


class VisionLLM:
    """An `agentspec.llm.base.LLM` over an image-text-to-text model.

    Args:
        model: the model, in evaluation mode, where it is to run.
        processor: its processor (tokenizer, image processor and chat template).
        name: model name in the records.
        max_context: context window in tokens; by default the model's.
        template_kwargs: variables of the chat template.
        max_image_side: pictures are scaled down until their longer side has at most this many pixels.
    """

    capabilities = frozenset({"images", "choices", "n", "token_ids"})

    def __init__(
        self,
        model: Any,
        processor: Any,
        *,
        name: str,
        max_context: int | None = None,
        template_kwargs: Mapping[str, Any] | None = None,
        max_image_side: int = LARGEST,
    ) -> None:
        self.name = name
        self.model = model
        self.processor = processor
        self.tokenizer = processor.tokenizer
        text_config = model.config.get_text_config()
        self.max_context = max_context or int(getattr(text_config, "max_position_embeddings", 0) or 8192)
        self.max_image_side = max_image_side
        self._template = dict(template_kwargs or {})
        self._end = _end_ids(model, self.tokenizer)
        self._lock = threading.Lock()

    @classmethod
    def load(
        cls,
        name_or_path: str | PathLike[str],
        *,
        dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto",
        device: str = "auto",
        name: str | None = None,
        **kwargs: Any,
    ) -> VisionLLM:
        """Load a model by folder or hub id.

        Args:
            name_or_path: which model.
            dtype: `"auto"` (as stored), `"float32"`, `"bfloat16"` or `"float16"`.
            device: `"auto"` (the first accelerator, else the CPU) or a torch device.
            name: model name in the records; by default the one it was found by.
            kwargs: as of `VisionLLM`.

        Raises:
            ModelNotFoundError: no such model.
            LLMError: its files cannot be loaded, or it is no vision-language model.
        """
        import torch
        from transformers import AutoModelForImageTextToText, AutoProcessor

        source = resolve(name_or_path)
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            with quiet():
                processor = AutoProcessor.from_pretrained(source.path)
                model = AutoModelForImageTextToText.from_pretrained(source.path, dtype=dtype).to(device).eval()
        except (OSError, ValueError, RuntimeError, ImportError) as error:
            raise LLMError(
                f"{source.path} cannot be loaded as a vision-language model: {error}; text models take "
                "`backend: local`, and some image processors need torchvision"
            ) from error
        if not hasattr(processor, "image_processor") or not getattr(processor, "chat_template", None):
            raise LLMError(
                f"{source.path} has no image processor with a chat template; give an instruction-tuned "
                "vision-language model, or `backend: local` for a text model"
            )
        return cls(model, processor, name=name or source.name, **kwargs)

    async def generate(self, request: Request) -> LLMCall:
        """Sample `request.sampling.n` completions.

        Raises:
            ContextOverflowError: prompt, pictures and answer do not fit.
            LLMError: the chat template refuses the turns.
        """
        began = time.perf_counter()
        prompt, completions = await asyncio.to_thread(self._answer, request)
        usage = Usage(len(prompt), sum(len(c.token_ids) for c in completions))
        latency = time.perf_counter() - began
        return LLMCall(request.id, request.tag, prompt, completions, request.sampling, usage, latency, self.name)

    async def score(
        self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = ""
    ) -> tuple[float, ...]:
        """Not offered.

        Raises:
            LLMError: always.
        """
        raise LLMError(f"{self.name} runs through its processor, which cannot score; use a method without `score`")

    def count_tokens(self, text: str) -> int:
        """Number of tokens of `text`."""
        return len(self.tokenizer.encode(text, add_special_tokens=False))

    def enter(self, episode: str) -> None:
        """Nothing to do: requests are answered one by one."""

    def leave(self, episode: str) -> None:
        """Nothing to do."""

    def _answer(self, request: Request) -> tuple[tuple[int, ...], tuple[Completion, ...]]:
        import torch

        sampling = request.sampling
        with self._lock, torch.no_grad():
            inputs = self._inputs(request.messages)
            prompt: list[int] = inputs["input_ids"][0].tolist()
            trie = self._trie(sampling.choices) if sampling.choices else None
            room = trie.longest if trie else sampling.max_tokens
            require_context(len(prompt), room, self.max_context)
            devices = [self.model.device] if self.model.device.type == "cuda" else []
            with torch.random.fork_rng(devices=devices):
                torch.manual_seed(request.seed & 0x7FFFFFFF)
                rows = self.model.generate(**inputs, **self._settings(sampling, trie, len(prompt), room))
            written = [row[len(prompt) :].tolist() for row in rows]
            written *= sampling.n // len(written)  # greedy answers are all the same: one is computed
        return tuple(prompt), tuple(self._completion(ids, sampling) for ids in written)

    def _inputs(self, messages: Sequence[Message]) -> Any:
        """What the processor makes of the prompt: ids, and pixels where there are pictures."""
        continued = messages[-1].role == "assistant"
        chat = [{"role": m.role, "content": [_part(p) for p in m.content]} for m in messages]
        try:
            text = self.processor.apply_chat_template(
                chat,
                tokenize=False,
                add_generation_prompt=not continued,
                continue_final_message=continued,
                **self._template,
            )
        except Exception as error:  # templates raise whatever they like
            raise LLMError(f"the chat template of {self.name} refuses the turns: {error}") from error
        images = [opened(fitted(p, self.max_image_side)) for p in pictures_of(messages)]
        seen = {"images": images} if images else {}
        return self.processor(text=[text], **seen, return_tensors="pt").to(self.model.device, self.model.dtype)

    def _settings(self, sampling: Sampling, trie: ChoiceTrie | None, start: int, room: int) -> dict[str, Any]:
        pad = self.tokenizer.pad_token_id
        settings: dict[str, Any] = {
            "max_new_tokens": room,
            "eos_token_id": sorted(self._end),
            "pad_token_id": min(self._end) if pad is None else pad,
            "do_sample": sampling.temperature > 0,
        }
        if sampling.temperature > 0:
            settings |= {"temperature": sampling.temperature, "top_p": sampling.top_p, "top_k": sampling.top_k}
            settings["num_return_sequences"] = sampling.n
        if trie is not None:
            settings["prefix_allowed_tokens_fn"] = lambda _, ids: _allowed(trie, ids[start:].tolist())
        elif sampling.stop:
            settings |= {"stop_strings": list(sampling.stop), "tokenizer": self.tokenizer}
        return settings

    def _trie(self, choices: Sequence[str]) -> ChoiceTrie:
        encoded = [self.tokenizer.encode(c, add_special_tokens=False) for c in choices]
        return ChoiceTrie(encoded, min(self._end))

    def _completion(self, ids: list[int], sampling: Sampling) -> Completion:
        ended = next((i for i, token in enumerate(ids) if token in self._end), None)
        text = self.tokenizer.decode(ids[:ended], skip_special_tokens=True)
        if ended is not None:
            ids = ids[: ended + 1]
        if sampling.choices:
            found = next((c for c in sampling.choices if c.strip() == text.strip()), None)
            return Completion(found or text, tuple(ids), finish_reason="choice" if found else "stop")
        cuts = [text.index(s) for s in sampling.stop if s in text]
        reason = "stop" if ended is not None or cuts else "length"
        return Completion(text[: min(cuts, default=len(text))], tuple(ids), finish_reason=reason)


def _part(part: Any) -> dict[str, str]:
    if isinstance(part, Picture):
        return {"type": "image"}
    return {"type": "text", "text": part if isinstance(part, str) else part.text}


def _allowed(trie: ChoiceTrie, written: Sequence[int]) -> list[int]:
    node = 0
    for token in written:
        if not trie.allowed(node):
            break
        node = trie.advance(node, token)
    return list(trie.allowed(node)) or [trie.end]


def _end_ids(model: Any, tokenizer: Any) -> frozenset[int]:
    configured = getattr(model.generation_config, "eos_token_id", None)
    listed = configured if isinstance(configured, list) else [configured]
    found = frozenset(i for i in (*listed, tokenizer.eos_token_id) if i is not None)
    if not found:
        raise LLMError("the model names no end-of-sequence token; set one in its tokenizer")
    return found
