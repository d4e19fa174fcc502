"""No model: what agents have that need none."""

from __future__ import annotations

from typing import Any

from agentspec.llm.base import LLMError
from agentspec.tokens import estimate_tokens


class NoLLM:
    """The backend of agents without a model: any call is an error that says so."""

    name = "none"
    capabilities: frozenset[str] = frozenset({"images"})  # nobody looks at them: scripted agents act on the state
    max_context = 0

    async def generate(self, request: Any) -> Any:
        raise LLMError(f"{request.tag.path} asked for a model, but none was configured; name one with `--model`")

    async def score(self, messages: Any, continuations: Any, *, episode: str = "") -> Any:
        raise LLMError("a module asked for scores, but no model was configured; name one with `--model`")

    def count_tokens(self, text: str) -> int:
        return estimate_tokens(text)

    def enter(self, episode: str) -> None:
        return None

    def leave(self, episode: str) -> None:
        return None
