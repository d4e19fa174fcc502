"""A model that answers from a script: for tests, demonstrators and replays, without weights and without chance.

The answer depends on the request alone, so any number of episodes may share one :class:`ScriptedLLM` and run in any
order. It is a full backend: its prompts and answers have token ids (:class:`ByteTokenizer`, reversible), its prompts
grow by exact extension like those of a real model, and constrained requests record their allowed tokens, so that
everything behind it (token sequences, masks, cost accounting) runs on the same records as with weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

from agentspec.llm.base import LLMError, Message, Request, Sampled, require_context
from agentspec.llm.constrain import ChoiceTrie
from agentspec.llm.pictures import refuse_pictures
from agentspec.types import Completion, LLMCall, Picture, Usage

Script = Sequence[str | Sequence[str]] | Callable[[Request], str | Sequence[str]]


class ByteTokenizer:
    """UTF-8 bytes as ids 0..255, and one id per role and for the end of a turn.

    A prompt is, for every turn, the id of its role, its bytes, and :data:`END`; then the assistant's id.
    """

    END = 256
    ROLES: ClassVar[dict[str, int]] = {"system": 257, "user": 258, "assistant": 259}
    vocab_size = 260

    def encode(self, text: str) -> tuple[int, ...]:
        """The bytes of ``text``."""
        return tuple(text.encode("utf-8"))

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ``ids``, without role and end ids; broken characters become U+FFFD."""
        return bytes(i for i in ids if i < 256).decode("utf-8", errors="replace")

    def render(self, messages: Sequence[Message]) -> list[int]:
        """Prompt ids; sampled ids are taken verbatim, and a last assistant turn is continued."""
        ids: list[int] = []
        last = len(messages) - 1
        for i, message in enumerate(messages):
            ids.append(self.ROLES[message.role])
            for part in message.content:
                if isinstance(part, Picture):
                    continue  # a scripted model that sees is shown the request, not its bytes
                if isinstance(part, Sampled):
                    ids.extend(part.token_ids or self.encode(part.text))
                else:
                    ids.extend(self.encode(part))
            if message.role == "assistant" and i == last:
                return ids
            if message.role != "assistant" or ids[-1] != self.END:
                ids.append(self.END)
        ids.append(self.ROLES["assistant"])
        return ids


class ScriptedLLM:
    """Answers from ``script``.

    Args:
        script: a function ``(Request) -> text`` (or a list of ``n`` texts), or a list of answers. Call number ``i``
            of an episode (``request.id``) gets answer ``i`` of the list, which starts again at its end; an answer may
            itself be a list of texts, one per sample.
        score: ``(messages, continuation) -> log-probability``; by default minus the number of bytes.
        name: model name in the records.
        max_context: context window in byte tokens.
        images: whether it takes pictures.
    """

    def __init__(
        self,
        script: Script,
        *,
        score: Callable[[Sequence[Message], str], float] | None = None,
        name: str = "scripted",
        max_context: int = 1_000_000,
        images: bool = False,
    ) -> None:
        if not callable(script) and (isinstance(script, str) or not script):
            raise ValueError(f"a script is a function or a non-empty list of answers, got {script!r}")
        self.name = name
        self.max_context = max_context
        self.tokenizer = ByteTokenizer()
        sees = {"images"} if images else set()
        self.capabilities = frozenset({"token_ids", "logprobs", "choices", "score", "n"} | sees)
        self._script = script
        self._score = score

    async def generate(self, request: Request) -> LLMCall:
        """The scripted answer to ``request``.

        Raises:
            LLMError: the answer is not one of ``choices``, or there are not ``n`` of them.
            ContextOverflowError: prompt plus ``max_tokens`` exceed ``max_context``.
        """
        if "images" not in self.capabilities:
            refuse_pictures(request.messages, self.name)
        sampling = request.sampling
        prompt = self.tokenizer.render(request.messages)
        if sampling.choices:
            trie = ChoiceTrie([self.tokenizer.encode(c) for c in sampling.choices], self.tokenizer.END)
            require_context(len(prompt), trie.longest, self.max_context)
            completions = tuple(self._choose(text, request, trie) for text in self._answers(request))
        else:
            require_context(len(prompt), sampling.max_tokens, self.max_context)
            completions = tuple(self._write(text, request) for text in self._answers(request))
        usage = Usage(input_tokens=len(prompt), output_tokens=sum(len(c.token_ids) for c in completions))
        return LLMCall(request.id, request.tag, tuple(prompt), completions, sampling, usage, 0.0, self.name)

    async def score(
        self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = ""
    ) -> tuple[float, ...]:
        """The scripted score of each continuation."""
        if self._score is None:
            return tuple(-float(len(self.tokenizer.encode(c))) for c in continuations)
        return tuple(float(self._score(messages, c)) for c in continuations)

    def count_tokens(self, text: str) -> int:
        """Bytes of ``text``."""
        return len(self.tokenizer.encode(text))

    def enter(self, episode: str) -> None:
        """Nothing to do: answers come at once."""

    def leave(self, episode: str) -> None:
        """Nothing to do."""

    def _answers(self, request: Request) -> list[str]:
        script = self._script
        answer = script(request) if callable(script) else script[request.id % len(script)]
        if isinstance(answer, str):
            return [answer] * request.sampling.n
        answers = list(answer)
        if len(answers) != request.sampling.n or not all(isinstance(a, str) for a in answers):
            raise LLMError(
                f"the script answered {request.tag.path} with {answers!r}; expected one text or a list of "
                f"{request.sampling.n} texts"
            )
        return answers

    def _choose(self, text: str, request: Request, trie: ChoiceTrie) -> Completion:
        if text not in request.sampling.choices:
            raise LLMError(
                f"the script answered {request.tag.path} with {text!r}, which is none of the choices "
                f"{list(request.sampling.choices)}; answer with one of `request.sampling.choices`"
            )
        ids = (*self.tokenizer.encode(text), self.tokenizer.END)
        return Completion(text, ids, (0.0,) * len(ids), trie.walk(ids), "choice")

    def _write(self, text: str, request: Request) -> Completion:
        sampling = request.sampling
        cuts = [(text.index(s), s) for s in sampling.stop if s in text]
        # Of the stop strings, the one that is complete first ends the text, as in token-by-token decoding.
        cut, stop = min(cuts, key=lambda c: (c[0] + len(c[1]), c[0]), default=(len(text), ""))
        ids = self.tokenizer.encode(text[: cut + len(stop)])
        if not stop:
            ids = (*ids, self.tokenizer.END)
        reason, text = "stop", text[:cut]
        if len(ids) > sampling.max_tokens:
            ids, reason = ids[: sampling.max_tokens], "length"
            text = self.tokenizer.decode(ids)
            text = text[:cut]
        return Completion(text, ids, (0.0,) * len(ids), (), reason)
