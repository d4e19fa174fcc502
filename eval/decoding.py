"""Prompts of recorded calls as text: token ids decoded by the tokenizer of the model that answered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from agentspec.llm.scripted import ByteTokenizer
from agentspec.types import LLMCall

Decode = Callable[[Sequence[int]], str]


@cache
def decoder_of(model: str) -> Decode | None:
    """How a model's ids are read; `None` where its tokenizer is not at hand (an endpoint, a folder that is gone)."""
    if model.startswith("scripted"):
        return ByteTokenizer().decode
    try:
        from transformers import AutoTokenizer

        from agentspec.llm.models import resolve

        folder: Any = resolve(model, None)
        tokenizer = AutoTokenizer.from_pretrained(str(folder.path))
    except Exception:  # whatever keeps a tokenizer from being read: the record is shown without it
        return None
    return lambda ids: str(tokenizer.decode(list(ids)))


def prompt_text(call: LLMCall, decode: Decode | None = None) -> str:
    """The whole prompt of a call, or empty where it cannot be read."""
    decode = decode or decoder_of(call.model)
    return decode(call.prompt_ids) if decode and call.prompt_ids else ""
