"""ReAct (Yao et al., 2023): thought, action and observation in one growing transcript.

In the paper a thought is an action of its own that the environment answers with nothing. Here a thought is a turn that
the scaffold acknowledges; it uses a step of the loop and none of the environment. With free-text actions one completion
usually holds thought and action, one call per step: any answer that reads as an action is one, however it is dressed.
An answer without one is a thought, and after `max_iterations` of those the action is asked for alone. An action that
cannot be read is asked for again (`max_retries`). In menu mode a thought is followed by the action, decoded under the
menu's constraint: two calls per step. A completion never writes observations: it is stopped where it begins one.

In the `conversation` layout the transcript is the context itself; in `snapshot` it is rendered into the user turn.
"""

from __future__ import annotations

from collections.abc import Sequence

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message
from agentspec.parameters import at_least
from agentspec.prompting import (
    MAX_RETRIES,
    Acted,
    ask_action,
    complaint,
    default_answer,
    read_call,
    sampled,
    static_prompt,
    user_turn,
)
from agentspec.reading import read
from agentspec.services import Services
from agentspec.state import dump_state, load_state
from agentspec.tokens import excerpt, news
from agentspec.types import Action, ActionError, AgentInput, Decision, Experience, Recall, Task, Transition
from agentspec.visible import visible

FORMAT = (
    "Work in turns. Write what you think in one or two sentences after 'Thought:', then one line "
    "'Action: NAME(arguments)'. The result comes back as the next observation; never write it yourself."
)
FORMAT_MENU = (
    "Work in turns: first write what you think in one sentence; once it is acknowledged, answer with one of the "
    "listed actions, word for word."
)
ACKNOWLEDGED = "OK."
STOP = ("\nObservation:",)
"""Not where an answer begins with it: a model that first says what it sees would be stopped before its first word."""


class ReAct:
    """Interleaved thought and action.

    Args:
        max_iterations: consecutive thoughts before the action is asked for alone.
        thought_tokens: most tokens of a thought (`None`: the spec's `max_tokens`).
        history: steps of transcript shown in the `snapshot` layout.
        max_retries: further calls for an action that cannot be read.
        observation_tokens: most tokens of each observation in that transcript, of what is new in it.
    """

    declaration = Declaration(
        "a growing transcript of thought, action and observation",
        calls=CallProfile(step=(1, 13)),
        purposes=Purpose.each("step", "think", "act"),
    )

    def __init__(
        self,
        services: Services,
        max_iterations: int = 10,
        thought_tokens: int | None = None,
        history: int = 10,
        max_retries: int = MAX_RETRIES,
        observation_tokens: int = 32,
    ) -> None:
        at_least("react", 1, max_iterations=max_iterations, history=history)
        at_least("react", 0, max_retries=max_retries, observation_tokens=observation_tokens)
        self.services = services
        self.max_iterations = max_iterations
        self.limit = {} if thought_tokens is None else {"max_tokens": thought_tokens}
        self.history = history
        self.max_retries = max_retries
        self.observation_tokens = observation_tokens
        self._transcript: list[str] = []
        self._before = ["", ""]  # the observation that was told last, and what came of the action then

    def begin_episode(self, task: Task) -> None:
        self._transcript, self._before = [], ["", ""]

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        menu = bool(input.action_schema.choices)
        snapshot = self.services.context.layout == "snapshot"
        told = self._transcript[-self.history :] if snapshot else []
        dynamic = user_turn(input, recall, self.services, transcript="\n".join(told), steps=len(told))
        messages = self.services.context.prompt(static_prompt(input, FORMAT_MENU if menu else FORMAT), dynamic)
        return await self._loop(input, messages)

    async def _loop(self, input: AgentInput, messages: Sequence[Message]) -> Decision:
        """Thoughts until an action comes, or until it is asked for alone."""
        schema = input.action_schema
        calls: list[tuple[int, int]] = []
        words: list[str] = []
        retries = self.max_retries
        thoughts, allowed = 0, 1 if schema.choices else self.max_iterations
        while thoughts < allowed:
            call = await self.services.llm.generate(
                "think" if schema.choices else "act", messages, stop=STOP, **self.limit
            )
            calls.append((call.id, 0))
            words.append(call.text)
            reading = read_call(call, schema)
            if isinstance(reading.action, Action) and not schema.choices:
                return self._decision(Acted(reading, call, tuple(calls)), words)
            reply = ACKNOWLEDGED
            meant = isinstance(reading.action, ActionError) and (
                reading.explicit
                or reading.action.code in ("TRUNCATED", "PARSE_AMBIGUOUS")
                or not visible(call.text)[0]  # nothing is no thought
            )
            if meant and not schema.choices:
                assert isinstance(reading.action, ActionError)
                self.services.count("truncated" if reading.action.code == "TRUNCATED" else "malformed")
                if not retries:
                    return self._decision(Acted(reading, call, tuple(calls)), words)
                reply = complaint(reading.action, schema)
                retries -= 1
            else:
                thoughts += 1
                if thoughts == allowed:
                    reply = f"{ACKNOWLEDGED} {default_answer(schema)}"
            messages = self.services.context.think((sampled(call),), reply)
        acted = await ask_action(self.services, messages, schema, max_retries=retries)
        return self._decision(Acted(acted.reading, acted.call, (*calls, *acted.calls)), words)

    @staticmethod
    def _decision(acted: Acted, words: list[str]) -> Decision:
        return Decision(
            acted.action,
            rationale="\n".join(words),
            calls=acted.calls,
            valid=acted.valid,
            turn=(sampled(acted.call),),
        )

    async def observe(self, transition: Transition) -> None:
        rationale = transition.decision.rationale
        reading = read(rationale, transition.input.action_schema)
        thought = reading.thought if isinstance(reading.action, Action) else visible(rationale)[0]
        thought = " ".join(thought.split()).removeprefix("Thought:").strip()
        self._see(transition.input.text)
        result = Experience.of(transition).feedback
        self._before = [transition.input.text, result]
        self._transcript.append(f"Thought: {thought}\nAction: {transition.action_text}\nObservation: {result}")

    def _see(self, observation: str) -> None:
        """Add to the step before what was observed after it; the newest observation stands in the prompt whole."""
        if not (self._transcript and self.observation_tokens and self.services.context.layout == "snapshot"):
            return
        if fresh := news(observation, *self._before):
            self._transcript[-1] += f" | {excerpt(fresh, self.observation_tokens, self.services.llm.count_tokens)}"

    def snapshot(self) -> bytes:
        return dump_state([self._before, self._transcript])

    def restore(self, blob: bytes) -> None:
        self._before, self._transcript = load_state(blob)
