"""The metered view of a backend that one episode's modules see.

A :class:`Recorder` belongs to one episode. It numbers and seeds every call, stamps who asked, keeps the
:class:`~agentspec.types.LLMCall` records that training and cost accounting read, and enforces a :class:`Budget`.
Modules never hold a backend, only a :class:`ModuleLLM`: the recorder bound to the module's name.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from agentspec.llm.base import LLM, LLMError, Message, Request
from agentspec.llm.pricing import Prices
from agentspec.tags import matches
from agentspec.types import CallTag, Credit, LLMCall, Sampling, Usage


class BudgetExceededError(LLMError):
    """The episode has used up its calls, tokens or dollars."""


@dataclass(frozen=True)
class Budget:
    """Upper bounds for one episode; ``None`` is unlimited. ``cost`` in dollars, ``tokens`` are input plus output."""

    calls: int | None = None
    tokens: int | None = None
    cost: float | None = None

    def __post_init__(self) -> None:
        for name in ("calls", "tokens", "cost"):
            limit = getattr(self, name)
            if limit is not None and not limit >= 0:  # NaN too
                raise ValueError(f"{name} is {limit}; expected a number of at least 0, or null (unlimited)")

    def check(self, calls: int, tokens: int, cost: float) -> None:
        """Raise :class:`BudgetExceededError` if one more call may not be made."""
        for name, limit, used in (
            ("calls", self.calls, calls),
            ("tokens", self.tokens, tokens),
            ("cost", self.cost, cost),
        ):
            if limit is not None and used >= limit:
                raise BudgetExceededError(
                    f"the budget of {limit} {name} per episode is used up (used {used}); raise `budget.{name}` "
                    "in the spec or choose a cheaper method"
                )


def derive_seed(*parts: object) -> int:
    """A 63-bit seed that depends on every part and on nothing else (stable across processes)."""
    text = "\x1f".join(str(p) for p in parts)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


class Recorder:
    """All model calls of one episode.

    Args:
        llm: the backend.
        episode: id of the episode, also the key under which the backend may cache its context.
        seed: every call's seed derives from it and the call's number.
        sampling: defaults of every call; modules override what their method fixes.
        budget: upper bounds for the episode.
        prices: dollars per token, by model name.
        helpers: pattern over module names (`memory.*`) -> the backend that answers these modules in place of `llm`.

    Attributes:
        step: stamped on every call. What is asked after step t, by `store`, belongs to step t + 1: it can earn only
            what comes after.
        problems: (module, what) -> how often something that is not an error went wrong.
        backend_error: what a backend raised that is no `LLMError`: a defect of the backend, not of a module.
    """

    def __init__(
        self,
        llm: LLM,
        *,
        episode: str,
        seed: int,
        sampling: Sampling | None = None,
        budget: Budget | None = None,
        prices: Prices | None = None,
        helpers: Mapping[str, LLM] | None = None,
    ) -> None:
        self.llm = llm
        self.helpers = dict(helpers or {})
        self.problems: Counter[tuple[str, str]] = Counter()
        self.backend_error: Exception | None = None
        self.episode = episode
        self.seed = seed
        self.sampling = sampling or Sampling()
        self.budget = budget or Budget()
        self.prices = prices or Prices()
        self.calls: list[LLMCall] = []
        self.step = 0
        self._next_id = 0
        self._tokens = 0
        self._cost = 0.0
        self.scorings = 0
        self.scored = Usage()

    async def generate(self, module: str, purpose: str, messages: Sequence[Message], **overrides: Any) -> LLMCall:
        """Ask the model; the record is kept. ``overrides`` are fields of :class:`~agentspec.types.Sampling`.

        Raises:
            BudgetExceededError: before the call, if the budget is used up.
        """
        branch = str(overrides.pop("branch", ""))
        # Concurrent calls of one episode each count from the moment they are made, not when they return.
        self.budget.check(self._next_id, self._tokens, self._cost)
        call_id, self._next_id = self._next_id, self._next_id + 1
        request = Request(
            messages=tuple(messages),
            sampling=replace(self.sampling, **overrides).with_room(),
            tag=CallTag(module, purpose, self.episode, self.step, branch),
            seed=derive_seed(self.seed, call_id),
            id=call_id,
        )
        llm = self.backend(module)
        try:
            call = await llm.generate(request)
        except LLMError:
            raise
        except Exception as error:
            self.backend_error = error
            raise
        model = call.model or llm.name
        usage = replace(call.usage, cost=self.prices.cost(model, call.usage))
        call = replace(call, usage=usage, model=model)
        self._tokens += usage.input_tokens + usage.output_tokens
        self._cost += usage.cost
        self.calls.append(call)
        return call

    def backend(self, module: str) -> LLM:
        """Who answers the calls of `module`."""
        return next((llm for pattern, llm in self.helpers.items() if matches(f"{module}/", pattern)), self.llm)

    async def score(
        self, messages: Sequence[Message], continuations: Sequence[str], module: str = ""
    ) -> tuple[float, ...]:
        """Log-probabilities of continuations; metered as input tokens and bounded by the token and cost budgets.

        A scoring samples nothing, so it is no call of its own: ``scorings`` counts them, ``scored`` their usage.

        Raises:
            BudgetExceededError: before the scoring, if the budget of tokens or dollars is used up.
        """
        replace(self.budget, calls=None).check(0, self._tokens, self._cost)
        llm = self.backend(module)
        try:
            scores = await llm.score(messages, continuations, episode=self.episode)
        except LLMError:
            raise
        except Exception as error:
            self.backend_error = error
            raise
        texts = [m.text for m in messages] + list(continuations)
        read = Usage(input_tokens=sum(map(llm.count_tokens, texts)))
        cost = self.prices.cost(llm.name, read)
        self.scorings += 1
        self.scored = Usage(self.scored.input_tokens + read.input_tokens, cost=self.scored.cost + cost)
        self._tokens += read.input_tokens
        self._cost += cost
        return scores

    def credit(self, call_id: int, completion: int, credit: Credit) -> None:
        """Say what one completion of one call was for.

        Raises:
            KeyError: no such call in this episode.
        """
        for i, call in enumerate(self.calls):
            if call.id == call_id:
                completions = list(call.completions)
                completions[completion] = replace(completions[completion], credit=credit)
                self.calls[i] = replace(call, completions=tuple(completions))
                return
        raise KeyError(f"call {call_id} was not made in episode {self.episode}; made: {[c.id for c in self.calls]}")

    @property
    def usage(self) -> Usage:
        """Totals of the episode so far, scorings included."""
        return Usage(
            input_tokens=sum(c.usage.input_tokens for c in self.calls) + self.scored.input_tokens,
            output_tokens=sum(c.usage.output_tokens for c in self.calls),
            cached_tokens=sum(c.usage.cached_tokens for c in self.calls),
            cost=sum(c.usage.cost for c in self.calls) + self.scored.cost,
        )


@dataclass(frozen=True)
class ModuleLLM:
    """A recorder bound to one module's name: what a module is given."""

    recorder: Recorder
    module: str

    async def generate(self, purpose: str, messages: Sequence[Message], **overrides: Any) -> LLMCall:
        """Ask the model for ``purpose``; keyword arguments override sampling fields (see :meth:`Recorder.generate`)."""
        return await self.recorder.generate(self.module, purpose, messages, **overrides)

    def executed(self, call: LLMCall, completion: int = 0) -> None:
        """Credit a completion that took effect outside a decision (a summary that became the context, say)."""
        self.recorder.credit(call.id, completion, "executed")

    def credit(self, call: LLMCall, completion: int, credit: Credit) -> None:
        """Say what a completion was for."""
        self.recorder.credit(call.id, completion, credit)

    def count(self, problem: str) -> None:
        """Count something that went wrong in this module."""
        self.recorder.problems[self.module, problem] += 1

    @property
    def window(self) -> int:
        """Tokens that the context of the module's model holds (0: unknown)."""
        return self.recorder.backend(self.module).max_context

    async def score(self, messages: Sequence[Message], continuations: Sequence[str]) -> tuple[float, ...]:
        """Log-probabilities of ``continuations`` after the prompt (see :meth:`Recorder.score`)."""
        return await self.recorder.score(messages, continuations, self.module)

    def count_tokens(self, text: str) -> int:
        """Tokens of ``text`` for budgets of prompt sections."""
        return self.recorder.backend(self.module).count_tokens(text)
