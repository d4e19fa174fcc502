"""Self-Refine (Madaan et al., 2023): feedback on an answer, another answer, and again, until the critic is content.

One model plays two roles in separate calls. The critic sees what the actor saw (memory and the conversation included),
the candidate action and its rationale, and says, before it is executed, what is wrong with it; the refiner answers
anew. Both are shown the history of attempts and feedback; of a long one the oldest feedback is cut, never an attempt.
It ends when the critic keeps the action, when a refinement changes nothing, or after `max_iterations`. The verdict is
asked for first, so that it cannot be cut off; a critic who gives none has not asked for a change. A refinement that is
no legal action is ignored: the action stands, and the history says so. An illegal first action is shown to the critic
with its error, so the method repairs what a reasoner could not parse.

When an action is replaced, its rationale is too; its calls are credited as explored and the refining call as executed;
a plan that goes on to guide later steps keeps its credit. Cost per step: 1 call (kept at once) to 2 per iteration.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Any

from agentspec.actions import same_action
from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message, system, user
from agentspec.llm.recorder import BudgetExceededError
from agentspec.parameters import at_least, settings
from agentspec.prompting import CALL_ANSWER, MENU_ANSWER, ON_REQUEST, clip, read_call, static_prompt, user_turn
from agentspec.services import Services
from agentspec.trajectory import Trajectory
from agentspec.types import Action, ActionError, AgentInput, Decision, LLMCall, Recall, Task
from agentspec.visible import visible

PRESETS = {"paper": {"max_iterations": 3, "feedback_tokens": 384}, "rl": {"max_iterations": 1, "feedback_tokens": 128}}

ATTEMPT = "Attempt {number}: {action}"
REASONS = "Its reasons: {reasons}"
FEEDBACK_ON = "Feedback on attempt {number}: {feedback}"
ASK_FEEDBACK = (
    "The latest attempt has not been carried out yet. Judge it as a strict critic: is it possible now, does it serve "
    "the task, is there something clearly better? Begin with a line 'Verdict: keep' if it should be carried out as it "
    "is, otherwise 'Verdict: change'. Then name concrete changes in one to three sentences."
)
ASK_REFINED = "Take all of the feedback into account and give a better attempt. {how}"

_VERDICT = re.compile(r"\bverdict\W{0,6}(keep|change)\b", re.IGNORECASE)


@dataclass
class Draft:
    """One revision under way: the situation, the history, the decision as it stands, and the refinements tried."""

    input: AgentInput
    situation: str
    decision: Decision
    history: list[str] = field(default_factory=list)
    attempts: int = 0
    tried: list[LLMCall] = field(default_factory=list)
    stopped: str = "max_iterations"

    def attempt(self, text: str) -> None:
        """Add an attempt to the history."""
        self.attempts += 1
        self.history.append(ATTEMPT.format(number=self.attempts, action=text))

    def comment(self, text: str) -> None:
        """Add what is said about the latest attempt: its reasons, or feedback."""
        if text:
            self.history.append(text)


class SelfRefine:
    """Feedback and refinement of every decision.

    Args:
        preset: `paper` (at most 3 iterations, as AgentSpec) or `rl` (1, short feedback).
        max_iterations: most pairs of feedback and refinement.
        feedback_tokens: most tokens of a feedback.
        history_tokens: budget of attempts and feedback in a prompt; the oldest feedback goes first.
        reason_tokens: most tokens shown of the rationale under judgement.
        conversation: show the conversation so far to critic and refiner.
    """

    declaration = Declaration(
        "a critic's feedback on the action before it is executed, and another attempt, until it is content",
        calls=CallProfile(step=(1, 6)),
        rl=CallProfile(step=(1, 2)),
        purposes=Purpose.each("step", "feedback", "refine"),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        max_iterations: int | None = None,
        feedback_tokens: int | None = None,
        history_tokens: int = 768,
        reason_tokens: int = 256,
        conversation: bool = True,
    ) -> None:
        given = {"max_iterations": max_iterations, "feedback_tokens": feedback_tokens}
        chosen: dict[str, int] = settings("self_refine", PRESETS, preset, given)
        at_least("self_refine", 1, **chosen)
        self.services = services
        self.max_iterations = chosen["max_iterations"]
        self.feedback_tokens = chosen["feedback_tokens"]
        self.history_tokens = history_tokens
        self.reason_tokens = reason_tokens
        self.conversation = conversation

    def begin_episode(self, task: Task) -> None:
        return None

    async def lessons(self, input: AgentInput) -> Recall:
        return Recall()

    async def revise(self, input: AgentInput, recall: Recall, decision: Decision) -> Decision:
        """The decision, refined; as far as the budget allows."""
        transcript = self.services.context.transcript
        draft = Draft(input, user_turn(input, recall, self.services, transcript=transcript), decision)
        draft.attempt(_shown(decision.action))
        draft.comment(self._reasons(decision.rationale))
        try:
            await self._refine(draft)
        except BudgetExceededError:
            draft.stopped = "budget"
        self._credit(decision, draft)
        trace: dict[str, Any] = {
            **draft.decision.trace,
            "refinements": len(draft.tried),
            "refining_ended": draft.stopped,
        }
        if draft.stopped == "budget":
            trace["exhausted"] = trace.get("exhausted") or "episode"
        return replace(draft.decision, trace=trace)

    def _reasons(self, rationale: str) -> str:
        reasons = clip(" ".join(visible(rationale)[0].split()), self.reason_tokens, self.services)
        return REASONS.format(reasons=reasons) if reasons else ""

    async def _refine(self, draft: Draft) -> None:
        for _ in range(self.max_iterations):
            answer = await self.services.ask("feedback", self._prompt(draft, ASK_FEEDBACK), self.feedback_tokens)
            if answer.problem == "budget":
                draft.stopped = "budget"
                return
            text = answer.value or ""
            verdicts = _VERDICT.findall(text)
            if not verdicts or verdicts[-1].casefold() == "keep":
                draft.stopped = "kept" if verdicts else "no verdict"
                return
            draft.comment(FEEDBACK_ON.format(number=draft.attempts, feedback=_VERDICT.sub("", text).strip(" \n*.")))
            if await self._another_attempt(draft):
                draft.stopped = "unchanged"
                return

    async def _another_attempt(self, draft: Draft) -> bool:
        """Refine once; whether the action stayed the same."""
        schema = draft.input.action_schema
        request = ASK_REFINED.format(how=MENU_ANSWER if schema.choices else CALL_ANSWER)
        choices = {"choices": schema.choices} if schema.choices else {}
        call = await self.services.llm.generate("refine", self._prompt(draft, request), **choices)
        draft.tried.append(call)
        reading = read_call(call, schema)
        action = reading.action
        if isinstance(action, ActionError):
            draft.attempt(f"{_shown(action)}; the attempt before it stands")
            return False
        standing = draft.decision.action
        if same_action(action, standing, schema):
            return True
        draft.attempt(action.text)
        trace = {k: v for k, v in draft.decision.trace.items() if k != "fallback"}
        draft.decision = replace(
            draft.decision,
            action=action,
            rationale=reading.thought or draft.history[-2],
            calls=((call.id, 0),),
            valid=True,
            turn=(action.text,),
            trace={**trace, "refined_from": draft.decision.action.text[:200]},
        )
        draft.comment(self._reasons(reading.thought))
        return False

    def _prompt(self, draft: Draft, request: str) -> tuple[Message, ...]:
        history = "\n".join(self._within(draft.history))
        turns = self._earlier_turns() if self.conversation else ()
        return (
            system(static_prompt(draft.input, ON_REQUEST)),
            *turns,
            user(f"{draft.situation}\n\n{history}\n\n{request}"),
        )

    def _earlier_turns(self) -> tuple[Message, ...]:
        """The conversation before this step, whose situation, attempts and reasons the request holds itself."""
        context = self.services.context
        return context.messages[1 : 1 + len(context.older(1))]

    def _within(self, history: list[str]) -> list[str]:
        """The history within its budget: attempts and the latest comment stay, older comments go first."""
        kept = list(history)
        comments = [i for i, line in enumerate(history[:-1]) if not line.startswith("Attempt ")]
        for i in comments:
            if self.services.llm.count_tokens("\n".join(kept)) <= self.history_tokens:
                break
            kept[i] = ""
        return [line for line in kept if line]

    def _credit(self, before: Decision, draft: Draft) -> None:
        """Credit moves to the call whose action is executed; the agent credits that one itself."""
        recorder = self.services.llm.recorder
        for call in draft.tried:
            recorder.credit(call.id, 0, "explored")
        if draft.decision.calls == before.calls:
            return
        purposes = {call.id: call.tag.purpose for call in recorder.calls}
        standing = tuple(c for c in before.calls if purposes.get(c[0]) == "plan")
        for call_id, completion in before.calls:
            recorder.credit(call_id, completion, "explored")
        draft.decision = replace(draft.decision, calls=(*standing, *draft.decision.calls))

    async def end_episode(self, trajectory: Trajectory) -> None:
        return None

    def snapshot(self) -> bytes:
        return b""

    def restore(self, blob: bytes) -> None:
        return None


def _shown(action: Action | ActionError) -> str:
    if isinstance(action, Action):
        return action.text
    return f"{action.text[:120]!r}, which is not possible: {action.message[:200]}"
