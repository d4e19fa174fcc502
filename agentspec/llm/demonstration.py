"""A backend that answers with an expert's actions: demonstrations in exactly the tokens a policy would have sampled.

The scaffold asks, the expert's recorded action of that episode and step is the answer, encoded and constrained as the
local backend would encode it. So an ordinary run of a scaffold becomes a set of training rows for a supervised warm
start, in the layout that reinforcement learning will use afterwards. What is asked besides actions is answered by
`write`, where somebody can (`agentspec.demonstration`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from agentspec.llm.base import LLMError, Message, Request
from agentspec.llm.chat import chat_format
from agentspec.llm.constrain import ChoiceTrie
from agentspec.types import Completion, LLMCall, Usage


class DemonstrationLLM:
    """Answers every acting call with the expert's action.

    Args:
        tokenizer: the policy's tokenizer.
        actions: episode id -> the expert's action texts in order.
        max_context: longest prompt and answer.

    Attributes:
        write: answers the calls that ask for no action, or raises `LLMError`; `None`: all of them are refused.
    """

    capabilities = frozenset({"token_ids", "logprobs", "choices"})

    def __init__(self, tokenizer: Any, actions: Mapping[str, Sequence[str]], max_context: int = 1 << 20) -> None:
        self.name = "demonstration"
        self.max_context = max_context
        self._format = chat_format(tokenizer)
        self._actions = actions
        self.write: Callable[[Request], str] | None = None

    async def generate(self, request: Request) -> LLMCall:
        """The expert's answer at the request's episode and step, with log-probability 0.

        Raises:
            LLMError: the expert has no action for this step, or it is not among the choices.
        """
        tag, choices = request.tag, request.sampling.choices
        known = self._actions.get(tag.episode, ())
        if tag.purpose != "act" and self.write is not None:
            text = self.write(request)
        elif tag.purpose != "act" or not 0 <= tag.step < len(known):
            raise LLMError(
                f"no demonstration for {tag.path} at step {tag.step} of episode {tag.episode}: it has {len(known)} "
                "actions; demonstrate inside a scaffold that makes one acting call per step (reasoning direct)"
            )
        else:
            text = known[tag.step]
        if choices and text not in choices:
            raise LLMError(f"the expert's action {text!r} is not among the choices {list(choices)}")
        end = self._format.end_of_turn
        ids = (*self._format.encode(text), *(() if end is None else (end,)))
        allowed: tuple[tuple[int, ...] | None, ...] = ()
        if choices and end is not None:
            allowed = ChoiceTrie([self._format.encode(c) for c in choices], end).walk(ids)
        prompt = tuple(self._format.render(request.messages))
        completion = Completion(text, ids, (0.0,) * len(ids), allowed, "choice" if choices else "stop")
        return LLMCall(
            request.id, tag, prompt, (completion,), request.sampling, Usage(len(prompt), len(ids)), model=self.name
        )

    async def score(self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = "") -> Any:
        """Refused: an expert has no probabilities."""
        raise LLMError("the demonstration backend cannot score; it only replays an expert's actions")

    def count_tokens(self, text: str) -> int:
        return self._format.count_tokens(text)

    def enter(self, episode: str) -> None:
        return None

    def leave(self, episode: str) -> None:
        return None
