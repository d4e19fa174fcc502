"""What the scaffold injects into a module: a metered model, time, chance, ids, embeddings, the running context.

`await services.ask(purpose, messages, max_tokens, parse=json_of(Schema))` is the one way to ask for anything that is
not the action. What comes back is an `Answer`, always: an answer that cannot be read, was cut off, or whose prompt is
too long for the model is a `problem` with a name. Problems are counted into the trajectory's metrics
(`memory/problems/malformed`, say), and every module says what it then does.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from agentspec.llm.base import ContextOverflowError, Message, assistant, user
from agentspec.llm.recorder import BudgetExceededError, ModuleLLM
from agentspec.structured import ParseError, Parser
from agentspec.types import Credit, LLMCall, Sampled
from agentspec.visible import visible

if TYPE_CHECKING:
    from agentspec.context import Context
    from agentspec.protocols import Embedder, Simulator

T = TypeVar("T")

Problem = Literal["", "malformed", "truncated", "overflow", "budget"]
"""What was wrong with an answer: could not be read; was cut off at `max_tokens`; its prompt (with the room for the
answer) does not fit into the model's window; the episode's budget allows no call."""

REPAIR = "That cannot be read: {problem}. Answer again with {expected} and nothing else."


@dataclass(frozen=True)
class Answer(Generic[T]):
    """What came of a question.

    Args:
        value: the parsed answer, or its text where nothing parses it; `None` if there is none that can be used.
        call: the newest call that was made for it; `None` if none could be made.
        problem: see `Problem`; empty if all is well. A text that was cut off has both a value and a problem, and so has
            an answer of which some items were left out.
    """

    value: T | None
    call: LLMCall | None = None
    problem: Problem = ""

    @property
    def text(self) -> str:
        """The answer as it was written; empty if there was no call."""
        return self.call.text if self.call else ""


@dataclass(frozen=True)
class Time:
    """Environment time: number of the episode in its run, steps since it began, and steps of the run so far.

    All count from 0. Under `scope: episode` every episode is the first of its run.
    """

    episode: int
    step: int
    total: int


class StepClock:
    """Time in environment steps, and the ids given out; both go on where an earlier episode of the run ended."""

    def __init__(self) -> None:
        self.step = 0
        self.episode = 0
        self.before = 0  # steps of the episodes before
        self._ids: dict[str, int] = {}

    def __call__(self) -> int:
        return self.step

    @property
    def time(self) -> Time:
        """Now."""
        return Time(self.episode, self.step, self.before + self.step)

    def new_id(self, module: str) -> int:
        """The next id of `module`: 0, 1, 2, ... over all episodes of the run."""
        number = self._ids.get(module, 0)
        self._ids[module] = number + 1
        return number

    def carry(self) -> dict[str, Any]:
        """What the next episode of the run starts from."""
        return {"episode": self.episode + 1, "before": self.before + self.step, "ids": dict(self._ids)}

    def resume(self, data: dict[str, Any]) -> None:
        """Go on from an earlier episode's `carry`."""
        self.episode, self.before, self._ids = data["episode"], data["before"], dict(data["ids"])


@dataclass
class Services:
    """What a module is given.

    Args:
        llm: the metered model, bound to the module's name.
        context: the running conversation of the episode (shared by the modules of one agent), with its `window`.
        clock: environment steps since the episode began.
        rng: the module's own generator, seeded by run, task, rollout and module.
        embedder: text embeddings, or `None` where the spec names no embedder.
        new_id: ids of the module, never the same twice in a run.
        simulator: the environment for search, or `None` where it has no snapshots.
        carried: whether a later episode starts from this one's memory (`scope: run`); otherwise what is written after
            the last step serves nobody.
    """

    llm: ModuleLLM
    context: Context
    clock: StepClock
    rng: random.Random
    embedder: Embedder | None = None
    new_id: Callable[[], int] = field(default_factory=lambda: itertools.count().__next__)
    simulator: Simulator | None = None
    carried: bool = True

    def time(self) -> Time:
        """Episode, step, and steps of the run so far."""
        return self.clock.time

    async def ask(
        self,
        purpose: str,
        messages: Sequence[Message] | str,
        max_tokens: int,
        parse: Parser[Any] | Callable[[str], Any] | None = None,
        *,
        credit: Credit = "aux",
        **sampling: Any,
    ) -> Answer[Any]:
        """Ask the model for something that is not the action; no stop strings or menu of the action apply.

        Args:
            purpose: what for, one of the purposes that the module declares.
            messages: the prompt; a text stands for one user turn.
            max_tokens: room for the answer.
            parse: reads the answer (`json_of(...)`, or a function that raises where it cannot); without it the value
                is the text without reasoning blocks, `None` if nothing is left.
            credit: what the call counts as for training, whether or not it can be read.
            sampling: other sampling fields, `temperature` for one.

        Returns:
            Always an answer; it has a `problem` where something was wrong, and the problem is counted. Where `parse`
            can salvage, what fits of an answer is its value, after the repair if there is one; the answer counts as
            `malformed`, and each item that was left out as `rejected`.
        """
        prompt = (user(messages),) if isinstance(messages, str) else tuple(messages)
        sampling = {"stop": (), "choices": (), **sampling, "max_tokens": max_tokens}
        repairs = parse.repairs if isinstance(parse, Parser) else 0
        answer = await self._ask_once(purpose, prompt, sampling, parse, credit)
        for _ in range(repairs):
            if answer.call is None or answer.value is not None:
                break
            written = Sampled.of(answer.call.completions[0])
            request = REPAIR.format(problem=self._why(parse, answer.text), expected=getattr(parse, "expected", ""))
            again = (*prompt, assistant(written), user(request))
            repaired = await self._ask_once(purpose, again, sampling | {"branch": "repair"}, parse, credit)
            self.count("repaired" if repaired.value is not None else "unrepaired")
            answer = self._better(parse, repaired, answer) if repaired.call else answer
        answer = self._salvaged(parse, answer)
        if answer.problem:
            self.count(answer.problem)
        return answer

    @staticmethod
    def _better(parse: Any, repaired: Answer[Any], first: Answer[Any]) -> Answer[Any]:
        """The repaired answer, unless only the first one can be used in part."""
        if repaired.value is None and _salvage(parse, repaired.text) is None and _salvage(parse, first.text):
            return first
        return repaired

    def _salvaged(self, parse: Any, answer: Answer[Any]) -> Answer[Any]:
        """What fits of an answer that does not fit as a whole; what was left out is counted."""
        found = _salvage(parse, answer.text) if answer.value is None and answer.call else None
        if found is None:
            return answer
        value, dropped = found
        for _ in range(dropped):
            self.count("rejected")
        return replace(answer, value=value)

    def count(self, problem: str) -> None:
        """Count something that went wrong, into the trajectory's metrics as `<kind>/problems/<problem>`."""
        self.llm.count(problem)

    async def _ask_once(
        self, purpose: str, messages: Sequence[Message], sampling: dict[str, Any], parse: Any, credit: Credit
    ) -> Answer[Any]:
        try:
            call = await self.llm.generate(purpose, messages, **sampling)
        except ContextOverflowError:
            return Answer(None, problem="overflow")
        except BudgetExceededError:
            return Answer(None, problem="budget")
        for i in range(len(call.completions)):
            self.llm.credit(call, i, credit)
        cut = call.completions[0].finish_reason == "length"
        if parse is None:
            text = visible(call.text)[0]
            return Answer(text or None, call, "truncated" if cut else "" if text else "malformed")
        try:
            return Answer(parse(call.text), call)
        except Exception:  # whatever a reader raises at a text it cannot read, the text is to blame
            return Answer(None, call, "truncated" if cut else "malformed")

    @staticmethod
    def _why(parse: Any, text: str) -> str:
        try:
            parse(text)
        except ParseError as error:
            return str(error)
        except Exception:
            pass
        return "it is not what was asked for"


def _salvage(parse: Any, text: str) -> tuple[Any, int] | None:
    """What of an answer can be used, and how many of its items cannot; `None` if nothing can."""
    if not isinstance(parse, Parser) or parse.salvage is None:
        return None
    try:
        return parse.salvage(text)
    except Exception:  # as with any reader, the text is to blame
        return None
