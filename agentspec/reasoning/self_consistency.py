"""Self-Consistency (Wang et al., 2023): independent chains of thought, and a majority vote over their actions.

The chains are samples of one prompt at a temperature above 0. What is counted are *canonical* actions, however they
were written; an answer without a legal action has no vote; of equally frequent actions the one that came first wins. In
menu mode every chain is followed by its own constrained choice, in a prompt that holds that chain alone.

A chain that ends without an action is asked for again; all of them together have `max_retries` further calls.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from agentspec.actions import canonical
from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, assistant, user
from agentspec.parameters import at_least, settings
from agentspec.prompting import (
    MAX_RETRIES,
    MENU_ANSWER,
    read_call,
    require_variety,
    sampled,
    static_prompt,
    user_turn,
)
from agentspec.protocols import Services
from agentspec.reasoning.common import Stateless
from agentspec.reasoning.cot import THINK, THINK_THEN_CALL
from agentspec.reasoning.search.meter import Ask, Meter, Unread, ask_again, last_resort
from agentspec.registry import SpecError
from agentspec.types import Action, ActionSchema, AgentInput, Decision, LLMCall, Recall

PRESETS = {"paper": {"samples": 5}, "rl": {"samples": 3}}


@dataclass(frozen=True)
class Vote:
    """One answer: its action, its text, and the completions that make it up."""

    action: Action
    rationale: str
    calls: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Answered:
    """An answer that should hold an action: the question, where it stands, and the completions and words before it."""

    ask: Ask
    call: LLMCall
    completion: int = 0
    before: tuple[tuple[int, int], ...] = ()
    words: str = ""


async def votes_of(
    meter: Meter, answers: Sequence[Answered], schema: ActionSchema
) -> list[tuple[Vote | None, LLMCall, int]]:
    """The vote of each answer and the completion it stands in; `None` if it holds no action, asked again or not."""
    readings = [read_call(a.call, schema, a.completion) for a in answers]
    lost = [i for i, reading in enumerate(readings) if not isinstance(reading.action, Action)]
    again = [Unread(_alone(answers[i].ask), answers[i].call, answers[i].completion) for i in lost]
    found = await ask_again(meter, again, schema, lambda call: isinstance(read_call(call, schema).action, Action))
    mended = dict(zip(lost, found, strict=True))
    votes: list[tuple[Vote | None, LLMCall, int]] = []
    for i, answer in enumerate(answers):
        call, completion = answer.call, answer.completion
        chain: tuple[tuple[int, int], ...] = ((call.id, completion),)
        read_later = mended.get(i)
        if read_later is not None:
            (call, chain), completion = read_later, 0
        action = read_call(call, schema, completion).action
        rationale = answer.words or call.completions[completion].text
        vote = Vote(action, rationale, (*answer.before, *chain)) if isinstance(action, Action) else None
        votes.append((vote, call, completion))
    return votes


def _alone(ask: Ask) -> Ask:
    """The same question for one sample."""
    return replace(ask, sampling={**ask.sampling, "n": 1})


@dataclass(frozen=True)
class Tally:
    """Votes per action, most frequent first, earlier first among equals."""

    groups: tuple[tuple[Vote, ...], ...]

    @classmethod
    def of(cls, votes: Sequence[Vote], schema: ActionSchema) -> Tally:
        """Count `votes` over canonical actions."""
        groups: dict[Hashable, list[Vote]] = {}
        for vote in votes:
            groups.setdefault(canonical(vote.action, schema), []).append(vote)
        return cls(tuple(tuple(g) for g in sorted(groups.values(), key=len, reverse=True)))  # sorted() is stable

    @property
    def winner(self) -> Vote | None:
        """The first vote for the winning action."""
        return self.groups[0][0] if self.groups else None

    @property
    def shares(self) -> tuple[tuple[str, float], ...]:
        """(action text, share of the votes)."""
        total = sum(len(g) for g in self.groups)
        return tuple((g[0].action.text, len(g) / total) for g in self.groups)


class SelfConsistency(Stateless):
    """A vote over independent chains.

    Args:
        preset: `paper` (5 samples, as AgentSpec) or `rl` (3).
        samples: chains per decision; `num_samples` is another name for it.
        sampling_temperature: temperature of the chains; above 0, or they would not be independent.
        credit: which completions are credited as executed: those of the answer `returned`, or of the whole
            `majority`; the others are credited as explored.
        max_retries: further calls for chains that hold no action, all of them together.
        thought_tokens: most tokens of a chain (`None`: the spec's `max_tokens`).
    """

    declaration = Declaration(
        "independent chains of thought, and a vote over their actions",
        calls=CallProfile(step=(1, 8)),
        rl=CallProfile(step=(1, 6)),
        purposes=Purpose.each("step", "think", "act"),
        needs=("n",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        samples: int | None = None,
        num_samples: int | None = None,
        sampling_temperature: float = 0.7,
        credit: str = "returned",
        thought_tokens: int | None = None,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        chosen = settings("self_consistency", PRESETS, preset, {"samples": num_samples if samples is None else samples})
        at_least("self_consistency", 1, samples=chosen["samples"])
        at_least("self_consistency", 0, max_retries=max_retries)
        require_variety("self_consistency", services, sampling_temperature, name="sampling_temperature")
        if credit not in ("returned", "majority"):
            raise SpecError(f"self_consistency: credit must be 'returned' or 'majority', got {credit!r}")
        self.services = services
        self.samples: int = chosen["samples"]
        self.max_retries = max_retries
        self.credit = credit
        self.sampling: dict[str, Any] = {"temperature": sampling_temperature}
        self.limit = {} if thought_tokens is None else {"max_tokens": thought_tokens}

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        schema = input.action_schema
        dynamic = user_turn(input, recall, self.services)
        messages = self.services.context.prompt(
            static_prompt(input, THINK if schema.choices else THINK_THEN_CALL), dynamic
        )
        meter = Meter(self.services.llm, retries=self.max_retries)
        answers = await (self._choose if schema.choices else self._answer)(meter, messages, schema)
        require_variety("self_consistency", self.services, self.sampling["temperature"], name="sampling_temperature")
        votes = [a for a in answers if a is not None]
        tally = Tally.of(votes, schema)
        trace = {
            "method": "self_consistency",
            "votes": [len(g) for g in tally.groups],
            "dropped": len(answers) - len(votes),
        }
        winner = tally.winner
        if winner is None:
            return await last_resort(meter, messages, schema, trace)
        credited = tally.groups[0] if self.credit == "majority" else (winner,)
        return Decision(
            winner.action,
            rationale=winner.rationale,
            candidates=tally.shares,
            calls=tuple(dict.fromkeys(c for vote in credited for c in vote.calls)),
            turn=(winner.action.text,),
            trace={**trace, **meter.trace()},
        )

    async def _answer(self, meter: Meter, messages: Sequence[Message], schema: ActionSchema) -> list[Vote | None]:
        """Chain and action in one completion; `None` for an answer without a legal action."""
        ask = Ask("act", messages, {"n": self.samples, **self.sampling, **self.limit}, credit="explored")
        asked = await meter.ask_all([ask])
        answers = [Answered(ask, call, i) for call in asked for i in range(len(call.completions))]
        return [vote for vote, _, _ in await votes_of(meter, answers, schema)]

    async def _choose(self, meter: Meter, messages: Sequence[Message], schema: ActionSchema) -> list[Vote | None]:
        """Chains as samples of one request, then one constrained choice after each of them, asked together."""
        asked = await meter.ask_all(
            [Ask("think", messages, {"n": self.samples, **self.sampling, **self.limit}, credit="explored")]
        )
        if not asked:
            return []
        chains = asked[0]
        asks = [
            Ask(
                "act",
                (*messages, assistant(sampled(chains, i)), user(MENU_ANSWER)),
                {"choices": schema.choices, **self.sampling},
                credit="explored",
            )
            for i in range(len(chains.completions))
        ]
        answers = [
            Answered(asks[i], call, 0, ((chains.id, i),), chains.completions[i].text)
            for i, call in enumerate(await meter.ask_all(asks))
        ]
        return [vote for vote, _, _ in await votes_of(meter, answers, schema)]
