"""Multi-agent debate (Du et al., 2023): several agents answer, read each other's answers, answer again, and vote.

Every agent has a dialogue of its own. Round 0 is independent. In each later round an agent is shown what the *others*
answered in the round before, all at once, checks it and its own, and gives an updated answer; nobody sees an answer of
the running round. The action is the majority of the last round over what actions do, the first one on a tie. A lone
agent is asked to check its own answer. As in the paper the agents are one model sampled at a temperature: greedy agents
would be copies of each other, and are refused.

An answer is quoted within `quote_tokens`: reasons are clipped, the proposed action never is.

An answer that names no action is asked for again at once, so that the others see one that does; all answers of a round
together have `max_retries` further calls.

In menu mode an answer is an argument in a call of its own and then the constrained choice, unless `argue` is off; the
agents then exchange bare actions. Cost per step: agents x (1 + rounds) calls, twice that with arguments in menu mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, assistant, user
from agentspec.parameters import at_least, settings
from agentspec.prompting import (
    MAX_RETRIES,
    MENU_ANSWER,
    quote,
    require_variety,
    sampled,
    static_prompt,
    user_turn,
    with_request,
)
from agentspec.protocols import Services
from agentspec.reasoning.common import Stateless
from agentspec.reasoning.search.meter import Ask, Meter, last_resort
from agentspec.reasoning.self_consistency import Answered, Tally, Vote, votes_of
from agentspec.types import ActionSchema, AgentInput, Decision, Recall

PRESETS = {
    "paper": {"num_agents": 3, "num_rounds": 2, "argue": True},
    "rl": {"num_agents": 2, "num_rounds": 1, "argue": False},
}

ANSWER = (
    "You are one of several advisers who debate the next action. Give your reasons in a few short sentences, then end "
    "with one line of the form\nAction: NAME(arguments)"
)
ARGUE = (
    "You are one of several advisers who debate the next action. When asked for reasons, say in at most three short "
    "sentences which action you favour and why; when asked for the action, answer with one of the listed actions, word "
    "for word."
)
OTHERS = (
    "This is what the other advisers answered:\n{answers}\n\nCheck their reasons and your own against the situation, "
    "step by step. Take over what holds, correct what does not, and answer again. {how}"
)
ALONE = "Check your answer once more, step by step, and answer again. {how}"
GIVE_REASONS = "Give your reasons."
END_WITH_ACTION = "End with one line of the form Action: NAME(arguments)."


@dataclass
class Adviser:
    """One agent: its private dialogue and its answers, newest last (`None`: no legal action in that round)."""

    messages: tuple[Message, ...]
    texts: list[str] = field(default_factory=list)
    votes: list[Vote | None] = field(default_factory=list)


class MultiAgentDebate(Stateless):
    """A debate per decision.

    Args:
        preset: `paper` (3 agents, 2 rounds after the first, as AgentSpec) or `rl` (2 agents, 1 round, no
            arguments in menu mode).
        num_agents: agents.
        num_rounds: rounds of debate after the independent one.
        argue: menu mode: argue in words before every choice.
        sampling_temperature: temperature of the answers; above 0, or the advisers would be one.
        quote_tokens: most tokens quoted of one other answer; its action is always among them.
        thought_tokens: most tokens of an answer in words (`None`: the spec's `max_tokens`).
        max_retries: further calls for answers that name no action, all of a round together.
    """

    declaration = Declaration(
        "agents answer, read each other's answers, answer again, and vote",
        calls=CallProfile(step=(9, 24)),
        rl=CallProfile(step=(4, 8)),
        purposes=Purpose.each("step", "argue", "act"),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        num_agents: int | None = None,
        num_rounds: int | None = None,
        argue: bool | None = None,
        sampling_temperature: float = 0.7,
        quote_tokens: int = 256,
        thought_tokens: int | None = None,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        given = {"num_agents": num_agents, "num_rounds": num_rounds, "argue": argue}
        chosen = settings("mad", PRESETS, preset, given)
        at_least("mad", 1, num_agents=chosen["num_agents"])
        at_least("mad", 0, num_rounds=chosen["num_rounds"])
        at_least("mad", 0, max_retries=max_retries)
        if chosen["num_agents"] > 1:
            require_variety("mad", services, sampling_temperature, name="sampling_temperature")
        self.services = services
        self.max_retries = max_retries
        self.temperature = sampling_temperature
        self.agents: int = chosen["num_agents"]
        self.rounds: int = chosen["num_rounds"]
        self.argue: bool = chosen["argue"]
        self.quote_tokens = quote_tokens
        self.limit: dict[str, Any] = {"temperature": sampling_temperature}
        if thought_tokens is not None:
            self.limit["max_tokens"] = thought_tokens

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        schema = input.action_schema
        dynamic = user_turn(input, recall, self.services)
        how = (ARGUE if self.argue else MENU_ANSWER) if schema.choices else ANSWER
        base = self.services.context.prompt(static_prompt(input, how), dynamic)
        advisers = [Adviser(base) for _ in range(self.agents)]
        meter = Meter(self.services.llm)
        for number in range(self.rounds + 1):
            meter.retries = self.max_retries
            if number:
                self._show_others(advisers, schema)
            await self._answer(meter, advisers, schema)
            if self.agents > 1:
                require_variety("mad", self.services, self.temperature, name="sampling_temperature")
            if meter.exhausted:
                break
        return self._vote(meter, advisers, schema) or await last_resort(
            meter, base, schema, _trace(advisers, self.rounds)
        )

    def _show_others(self, advisers: Sequence[Adviser], schema: ActionSchema) -> None:
        """Quote to each agent what the others answered last, before anyone answers again."""
        how = "" if schema.choices else END_WITH_ACTION
        quotes = [
            quote(a.texts[-1], a.votes[-1].action if a.votes[-1] else None, self.quote_tokens, self.services)
            for a in advisers
        ]
        for i, adviser in enumerate(advisers):
            others = "\n".join(f"Adviser {j + 1}: {q}" for j, q in enumerate(quotes) if j != i)
            text = OTHERS.format(answers=others, how=how) if others else ALONE.format(how=how)
            adviser.messages = (*adviser.messages, user(text.strip()))

    async def _answer(self, meter: Meter, advisers: Sequence[Adviser], schema: ActionSchema) -> None:
        """One round: all agents at once. The budget may end it among them; the others keep their last answers."""
        arguments: list[tuple[tuple[int, int], ...]] = [()] * len(advisers)
        words = [""] * len(advisers)
        if schema.choices and self.argue:
            asks = [Ask("argue", with_request(a.messages, GIVE_REASONS), self.limit, "explored") for a in advisers]
            for i, call in enumerate(await meter.ask_all(asks)):
                adviser, arguments[i], words[i] = advisers[i], ((call.id, 0),), call.text.strip() + "\n"
                adviser.messages = (*asks[i].messages, assistant(sampled(call)), user(MENU_ANSWER))
            if meter.exhausted:
                return
        sampling = {"choices": schema.choices, "temperature": self.temperature} if schema.choices else self.limit
        asks = [Ask("act", a.messages, sampling, "explored") for a in advisers]
        answers = [Answered(asks[i], call, 0, arguments[i]) for i, call in enumerate(await meter.ask_all(asks))]
        for i, (vote, call, _) in enumerate(await votes_of(meter, answers, schema)):
            text = f"{words[i]}Action: {call.text}" if words[i] else call.text
            advisers[i].messages = (*advisers[i].messages, assistant(sampled(call)))
            advisers[i].texts.append(text)
            advisers[i].votes.append(replace(vote, rationale=text) if vote else None)

    def _vote(self, meter: Meter, advisers: Sequence[Adviser], schema: ActionSchema) -> Decision | None:
        """The majority of each agent's last answers; if none of them is legal, of the newest round that has one."""
        trace = _trace(advisers, self.rounds)
        newest = [a.votes[-1] for a in advisers if a.votes]
        last = Tally.of([v for v in newest if v is not None], schema)
        if last.winner is not None:
            return _decision(last, {**trace, **meter.trace()}, valid=True)
        for number in range(self.rounds - 1, -1, -1):
            votes = [a.votes[number] for a in advisers if number < len(a.votes)]
            earlier = Tally.of([v for v in votes if v is not None], schema)
            if earlier.winner is not None:
                fallback = f"no legal answer in the last round; the vote of round {number}"
                return _decision(earlier, {**trace, **meter.trace(), "fallback": fallback}, valid=False)
        return None


def _trace(advisers: Sequence[Adviser], rounds: int) -> dict[str, Any]:
    """What was proposed in each round."""
    said = [[a.votes[r] for a in advisers if r < len(a.votes)] for r in range(rounds + 1)]
    return {"method": "mad", "rounds": [[v.action.text if v else None for v in votes] for votes in said if votes]}


def _decision(tally: Tally, trace: dict[str, Any], *, valid: bool) -> Decision:
    winner = tally.groups[0][0]
    return Decision(
        winner.action,
        rationale=winner.rationale,
        candidates=tally.shares,
        calls=winner.calls,
        valid=valid,
        turn=(winner.action.text,),
        trace={**trace, "votes": [len(g) for g in tally.groups]},
    )
