"""A backend that plays an episode's beginning again: recorded answers first, then those of a live model.

An episode repeats (`agentspec.episode`), so that recorded answers bring it into exactly the state they left: the
environment, the memory, the conversation and the reasoner are what they were, whether or not they can be restored from
a snapshot.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from agentspec.llm.base import LLM, ContextOverflowError, LLMError, Message, Request
from agentspec.llm.recorder import derive_seed
from agentspec.types import LLMCall

Key = tuple[int, str, str]
"""Step, path and branch of a call; several of one key are told apart by their order."""


class WithheldError(ContextOverflowError):
    """The answer is withheld; a module treats it as a prompt that does not fit: a counted no-op."""


def key_of(asked: LLMCall | Request) -> Key:
    """What a call answers."""
    return asked.tag.step, asked.tag.path, asked.tag.branch


class ReplayedLLM:
    """Gives the recorded `calls` once each, then what `llm` answers.

    Args:
        step: the first step at which something may be asked that was not recorded.
        withheld: whether a request that is not answered by a record gets no answer at all.
        seeds: what the seeds of live answers derive from.
        suffix: of the episode's name before the live model, where its other replays play beside it.
    """

    def __init__(
        self,
        llm: LLM,
        calls: Iterable[LLMCall],
        *,
        step: int,
        withheld: Callable[[Request], bool],
        seeds: Sequence[int | str],
        suffix: str,
    ) -> None:
        self.llm, self.step, self.withheld, self.seeds, self.suffix = llm, step, withheld, seeds, suffix
        self.name, self.capabilities, self.max_context = llm.name, llm.capabilities, llm.max_context
        self._given: defaultdict[Key, list[LLMCall]] = defaultdict(list)
        self._asked: Counter[Key] = Counter()
        for call in calls:
            self._given[key_of(call)].append(call)

    async def generate(self, request: Request) -> LLMCall:
        """The recorded answer, the live one, or none.

        Raises:
            WithheldError: the answer is withheld.
            LLMError: something else is asked than was recorded.
        """
        key = key_of(request)
        number = self._asked[key]
        self._asked[key] += 1
        if number < len(self._given[key]):
            return replace(self._given[key][number], id=request.id)
        if self.withheld(request):
            raise WithheldError(f"{request.tag.path} of step {request.tag.step} is withheld")
        if request.tag.step < self.step:
            raise LLMError(f"{request.tag.path} of step {request.tag.step} was not asked when the episode was recorded")
        seed = derive_seed(*self.seeds, *key, number)
        live = replace(request, seed=seed, tag=replace(request.tag, episode=self._name(request.tag.episode)))
        return replace(await self.llm.generate(live), tag=request.tag)

    async def score(
        self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = ""
    ) -> tuple[float, ...]:
        """As the live model scores."""
        return await self.llm.score(messages, continuations, episode=self._name(episode))

    def count_tokens(self, text: str) -> int:
        """As the live model counts."""
        return self.llm.count_tokens(text)

    def enter(self, episode: str) -> None:
        """Goes live under a name of its own."""
        self.llm.enter(self._name(episode))

    def leave(self, episode: str) -> None:
        """Its own name ends."""
        self.llm.leave(self._name(episode))

    def _name(self, episode: str) -> str:
        return f"{episode}{self.suffix}" if episode else ""
