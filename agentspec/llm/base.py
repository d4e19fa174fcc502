"""What a language model is to the scaffold: messages in, sampled tokens out.

A prompt is a list of :class:`Message`. An assistant message may contain :class:`Sampled` parts: text that a model wrote
earlier, with the token ids it was sampled as. A backend that works on tokens puts exactly those ids into the next
prompt: model output is never decoded and re-encoded. If the last message is the assistant's, the completion continues
that turn (a chain of thought is followed by a constrained choice in this way).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from agentspec.types import CallTag, LLMCall, Part, Picture, Sampled, Sampling

__all__ = [
    "LLM",
    "Capability",
    "ContextOverflowError",
    "LLMError",
    "Message",
    "Part",
    "Picture",
    "Request",
    "Sampled",
    "assistant",
    "system",
    "user",
]

Capability = Literal["token_ids", "logprobs", "choices", "score", "n", "images"]
"""What a backend can do beyond plain sampling; a module's ``needs`` are checked against it before a run."""


class LLMError(RuntimeError):
    """The model could not answer: what was asked, what happened, and what to do about it."""


class ContextOverflowError(LLMError):
    """The prompt and the room for an answer do not fit into the model's context window."""


@dataclass(frozen=True)
class Message:
    """One chat turn: a tuple of parts. System turns hold plain text, user turns text and pictures."""

    role: Literal["system", "user", "assistant"]
    content: tuple[Part | Picture, ...]

    @property
    def text(self) -> str:
        """The turn as plain text; a picture has none."""
        return "".join(p if isinstance(p, str) else p.text for p in self.content if not isinstance(p, Picture))


def system(text: str) -> Message:
    """A system turn."""
    return Message("system", (text,))


def user(text: str, *pictures: Picture) -> Message:
    """A user turn; pictures stand before the text."""
    return Message("user", (*pictures, text))


def assistant(*parts: Part) -> Message:
    """An assistant turn made of literal text and sampled parts."""
    return Message("assistant", parts)


@dataclass(frozen=True)
class Request:
    """One question to a model. ``seed`` fixes the sampling of this request whatever it is batched with."""

    messages: tuple[Message, ...]
    sampling: Sampling
    tag: CallTag
    seed: int = 0
    id: int = 0


@runtime_checkable
class LLM(Protocol):
    """A backend. Its methods may be awaited by many episodes at once."""

    name: str
    capabilities: frozenset[str]
    max_context: int

    async def generate(self, request: Request) -> LLMCall:
        """Sample ``request.sampling.n`` completions.

        Raises:
            ContextOverflowError: prompt plus ``max_tokens`` exceed ``max_context``.
            LLMError: anything else that kept the model from answering.
        """
        ...

    async def score(
        self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = ""
    ) -> tuple[float, ...]:
        """Sum of log-probabilities (natural, temperature 1) of each continuation after the prompt.

        ``episode`` says who asks, as ``request.tag.episode`` does in :meth:`generate`.
        """
        ...

    def count_tokens(self, text: str) -> int:
        """Number of tokens of ``text`` (an estimate where the tokenizer is remote)."""
        ...

    def enter(self, episode: str) -> None:
        """An episode goes live: a batching backend waits for it before it runs a batch."""
        ...

    def leave(self, episode: str) -> None:
        """A live episode ended; what was cached for it may go."""
        ...


def require_context(prompt_tokens: int, max_tokens: int, max_context: int) -> None:
    """Refuse a request that does not fit.

    Raises:
        ContextOverflowError: ``prompt_tokens + max_tokens > max_context``.
    """
    if prompt_tokens + max_tokens > max_context:
        raise ContextOverflowError(
            f"the prompt has {prompt_tokens} tokens and the answer may have {max_tokens}, but the model's context is "
            f"{max_context}; shorten the memory budget or `max_turns`, lower `max_tokens`, or summarise"
        )
