"""The budget of one decision: calls and tokens, and what happens when they run out.

A method with many calls per decision asks the model through a `Meter`. Questions that do not depend on each
other are asked together (`Meter.ask_all`), so that a batching backend runs them as one batch. Three things may
end a search early: the method's own limits, the episode's budget, and a prompt that outgrew the model's context. All
three raise `OutOfBudgetError`; the method catches it and answers with the best action it has, flagged by
`trace["exhausted"]`.

An answer that holds no action is asked for again, with what was wrong, as long as the decision's `retries` last
(`ask_again`). If there is no action at all then, one plain question for it follows, with what is left of them
(`last_resort`); only then there is nothing to answer with (`Meter.undecided`).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from agentspec.llm.base import ContextOverflowError, LLMError, Message
from agentspec.llm.recorder import BudgetExceededError, ModuleLLM
from agentspec.prompting import complaint, default_answer, in_private, read_call, sampled, with_request
from agentspec.reading import read
from agentspec.types import Action, ActionError, ActionSchema, Credit, Decision, LLMCall


class OutOfBudgetError(BudgetExceededError):
    """The search may not go on: its own limits, the episode's budget or the model's context are used up."""


@dataclass(frozen=True)
class Ask:
    """One question: what for, the prompt, sampling overrides, and the credit of its completions."""

    purpose: str
    messages: Sequence[Message]
    sampling: Mapping[str, Any] = field(default_factory=dict)
    credit: Credit = "aux"


@dataclass(frozen=True)
class Unread:
    """An answer that holds no action: the question (as it is asked again), and which completion of which call."""

    ask: Ask
    call: LLMCall
    completion: int = 0


class Meter:
    """A module's model under the budget of one decision.

    Args:
        llm: the module's metered model.
        calls: most requests and scorings (`None`: no limit).
        tokens: once this many tokens went in and out, no further request is made (`None`: no limit).
        retries: further calls that may be made for answers without an action.

    Attributes:
        exhausted: what ran out: `"calls"`, `"tokens"`, `"episode"` (its budget), `"context"`, or empty.
        answered: the first answer that proposed an action, for messages about what could not be read.
    """

    def __init__(
        self, llm: ModuleLLM, calls: int | None = None, tokens: int | None = None, *, retries: int = 0
    ) -> None:
        self._llm = llm
        self.retries = retries
        self.asked_again = 0
        self._limits = {"calls": calls, "tokens": tokens}
        self.calls = 0
        self.scorings = 0
        self.tokens = 0
        self.exhausted = ""
        self.answered = ""
        self._error: LLMError | None = None

    @property
    def constrains(self) -> bool:
        """Whether the backend decodes under a constraint."""
        return "choices" in self._llm.recorder.llm.capabilities

    async def ask(self, purpose: str, messages: Sequence[Message], credit: Credit = "aux", **sampling: Any) -> LLMCall:
        """One request.

        Raises:
            OutOfBudgetError: it may not be made.
        """
        calls = await self.ask_all([Ask(purpose, messages, sampling, credit)])
        self.stop()
        return calls[0]

    async def ask_all(self, asks: Sequence[Ask]) -> list[LLMCall]:
        """Independent requests, made together; answers in their order.

        Fewer answers than requests come back when the budget ends among them: the first ones. Use those, then call
        `stop`.
        """
        asks = asks[: self._allowed(len(asks))]
        self.calls += len(asks)
        answers = await asyncio.gather(*(self._ask(a) for a in asks), return_exceptions=True)
        calls: list[LLMCall] = []
        for answer in answers:
            if isinstance(answer, LLMCall):
                calls.append(answer)
            elif isinstance(answer, BudgetExceededError | ContextOverflowError):
                if not self.exhausted:
                    self.exhausted = "episode" if isinstance(answer, BudgetExceededError) else "context"
                    self._error = answer
            else:
                raise answer
        # With one prompt too long among others, those after it would be taken for its answers.
        return calls if len(calls) == len(asks) else calls[: _first_failure(answers)]

    async def _ask(self, ask: Ask) -> LLMCall:
        call = await self._llm.generate(ask.purpose, ask.messages, **ask.sampling)
        self.tokens += call.usage.input_tokens + call.usage.output_tokens
        if ask.credit != "aux":
            self.answered = self.answered or call.text
            for i in range(len(call.completions)):
                self._llm.recorder.credit(call.id, i, ask.credit)
        return call

    async def score_all(self, asks: Sequence[tuple[Sequence[Message], Sequence[str]]]) -> list[tuple[float, ...]]:
        """Log-probabilities of continuations after their prompts; one scoring each.

        Raises:
            OutOfBudgetError: not all of them may be made.
        """
        if self._allowed(len(asks)) < len(asks):
            self.stop()
        self.scorings += len(asks)
        for messages, continuations in asks:
            self.tokens += sum(self._llm.count_tokens(text) for text in (*(m.text for m in messages), *continuations))
        try:
            return list(await asyncio.gather(*(self._llm.score(m, c) for m, c in asks)))
        except (BudgetExceededError, ContextOverflowError) as error:
            self.exhausted = "episode" if isinstance(error, BudgetExceededError) else "context"
            self._error = error
            raise OutOfBudgetError(str(error)) from error

    def _allowed(self, wanted: int) -> int:
        """How many of `wanted` requests the limits leave room for."""
        if self.exhausted:
            return 0
        if self._limits["tokens"] is not None and self.tokens >= self._limits["tokens"]:
            self.exhausted = "tokens"
            return 0
        room = wanted if self._limits["calls"] is None else self._limits["calls"] - self.calls - self.scorings
        if room < wanted:
            self.exhausted = "calls"
        return max(0, min(wanted, room))

    def retry(self, wanted: int) -> int:
        """How many of `wanted` answers may be asked for again now; they are taken off `retries`."""
        granted = 0 if self.exhausted else min(wanted, self.retries)
        self.retries -= granted
        self.asked_again += granted
        return granted

    def count(self, error: ActionError) -> None:
        """Count an answer that holds no action."""
        self._llm.count("truncated" if error.code == "TRUNCATED" else "malformed")

    def stop(self) -> None:
        """Raise `OutOfBudgetError` if something ran out."""
        if self.exhausted:
            limit = self._limits.get(self.exhausted)
            raise OutOfBudgetError(
                str(self._error) if self._error else f"the search's limit of {limit} {self.exhausted} is reached"
            )

    def trace(self) -> dict[str, Any]:
        """What a decision's trace says about its cost, and what ran out if something did."""
        spent: dict[str, Any] = {"calls": self.calls, "tokens": self.tokens}
        if self.scorings:
            spent["scorings"] = self.scorings
        if self.asked_again:
            spent["asked_again"] = self.asked_again
        if self.exhausted:
            spent["exhausted"] = self.exhausted
        return spent

    def undecided(self, trace: Mapping[str, Any]) -> Decision:
        """The flagged fallback when no legal action was found: an error that the environment answers.

        Args:
            trace: the method's trace.

        Raises:
            LLMError: the episode's budget or the model's context is what ran out; the episode ends in an orderly way.
        """
        if self._error is not None:
            raise self._error
        message = f"no legal action was found among the answers (the first reads {self.answered[:60]!r})"
        return Decision(
            ActionError("NO_ACTION", message, self.answered[:200]),
            valid=False,
            trace={**trace, **self.trace(), "fallback": "nothing parsed"},
        )


async def ask_again(
    meter: Meter, unread: Sequence[Unread], schema: ActionSchema, found: Callable[[LLMCall], bool]
) -> list[tuple[LLMCall, tuple[tuple[int, int], ...]] | None]:
    """Answers without an action, asked for again together with what was wrong, while the meter's retries last.

    Args:
        meter: of the decision.
        unread: the answers.
        schema: the actions.
        found: whether an answer holds what was asked for.

    Returns:
        For each of them the answer that does, and all (call id, completion) that it took; `None` if there is none.
    """
    prompts = [u.ask.messages for u in unread]
    answered = [(u.call, u.completion) for u in unread]
    chains: list[tuple[tuple[int, int], ...]] = [((u.call.id, u.completion),) for u in unread]
    results: list[tuple[LLMCall, tuple[tuple[int, int], ...]] | None] = [None] * len(unread)
    waiting = list(range(len(unread)))
    while granted := meter.retry(len(waiting)):
        now, waiting = waiting[:granted], waiting[granted:]
        for i in now:
            call, completion = answered[i]
            error = read_call(call, schema, completion).action
            if isinstance(error, ActionError):
                meter.count(error)
            reply = complaint(error, schema) if isinstance(error, ActionError) else default_answer(schema)
            prompts[i] = in_private(prompts[i], sampled(call, completion), reply)
        asks = [replace(unread[i].ask, messages=prompts[i]) for i in now]
        for i, call in zip(now, await meter.ask_all(asks), strict=False):  # fewer when the budget ended among them
            answered[i], chains[i] = (call, 0), (*chains[i], (call.id, 0))
            if found(call):
                results[i] = (call, chains[i])
            else:
                waiting.append(i)
    return results


async def last_resort(
    meter: Meter, messages: Sequence[Message], schema: ActionSchema, trace: Mapping[str, Any]
) -> Decision:
    """The decision of a method none of whose answers held a legal action: it is asked for plainly, told what was wrong.

    Args:
        meter: of the decision; its limits hold, and what is left of its retries.
        messages: the step's prompt, ending in the observation.
        schema: the actions.
        trace: the method's trace.
    """
    error = read(meter.answered, schema).action
    reply = complaint(error, schema) if isinstance(error, ActionError) else default_answer(schema)
    prompt: Sequence[Message] = with_request(messages, reply)
    sampling = {"choices": schema.choices} if schema.choices else {}
    calls: list[tuple[int, int]] = []
    while meter.retry(1):
        asked = await meter.ask_all([Ask("act", prompt, sampling, "executed")])
        if not asked:
            break
        (call,) = asked
        calls.append((call.id, 0))
        reading = read_call(call, schema)
        if isinstance(reading.action, Action):
            return Decision(
                reading.action,
                rationale=call.text,
                calls=tuple(calls),
                turn=(reading.action.text,),
                trace={**trace, **meter.trace()},
            )
        prompt = in_private(prompt, sampled(call), complaint(reading.action, schema))
    return meter.undecided(trace)


def _first_failure(answers: Sequence[object]) -> int:
    return next(i for i, answer in enumerate(answers) if not isinstance(answer, LLMCall))
