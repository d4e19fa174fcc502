"""Plan-and-Solve (Wang et al., 2023): understand the task and plan first, then carry the plan out step by step.

For an acting agent the plan persists: a numbered list of sub-goals is made once, and every step works on the current
one. A step that reports its sub-goal as done moves on to the next. A new plan is made when the plan is carried out,
after ``replan_failures`` failed actions in a row (the failures are shown to the planner), or every ``replan_every``
steps. ``one_call`` is the paper's own form: plan and solution in one completion, anew at every step.

In the ``conversation`` layout plan and planner's request are turns of the conversation, exactly as sampled, so an
episode stays one token sequence; the plan is shown again when the conversation no longer holds it.
"""

from __future__ import annotations

import re
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message
from agentspec.protocols import Services
from agentspec.reasoning.common import (
    ON_REQUEST,
    ask_action,
    at_least,
    clip,
    default_answer,
    read_action,
    sampled,
    settings,
    static_prompt,
    user_turn,
)
from agentspec.state import dump_state, load_state
from agentspec.types import Action, AgentInput, Decision, LLMCall, Recall, Task, Transition

PRESETS = {"paper": {"think": True, "plan_tokens": 256}, "rl": {"think": False, "plan_tokens": 96}}

PLAN = "First understand the task. Then devise a plan: a numbered list of at most {most} short sub-goals, in order."
PLAN_PLUS = " Note the quantities that matter with their values, and work out what follows from them (times, amounts)."
REPLAN = "The last plan {why}. {failures}Devise a better one from where things stand."
SOLVE_FREE = (
    "Carry out the plan. Work out in a sentence or two what sub-goal {number} ({goal}) needs now, write 'Sub-goal "
    "done' if it is achieved already, and end with one line of the form\nAction: NAME(arguments)"
)
THINK_MENU = (
    "Carry out the plan. Work out in a sentence or two what sub-goal {number} ({goal}) needs now; write 'Sub-goal "
    "done' if it is achieved already. Do not name the action yet."
)
ACT_MENU = "You are at sub-goal {number} of the plan: {goal}."
ONE_CALL = (
    "First understand the task and devise a plan. Then carry out its first step: end with one line of the form\n"
    "Action: NAME(arguments)"
)
SHOW_PLAN = "Plan:\n{plan}"

_NUMBERED = re.compile(r"^\s*(?:\(?\d+[.):]|[-*•])\s*(\S.*)$", re.MULTILINE)
_DONE = re.compile(r"\bsub-?goal(?:\s+\d+)?(?:\s+is)?\s+(?:done|achieved|complete)", re.IGNORECASE)


class PlanAndSolve:
    """A persistent plan, and steps that carry it out.

    Args:
        preset: ``paper`` (menu mode thinks before it acts) or ``rl`` (it does not, and plans are short).
        think: menu mode: work the step out in words before the constrained choice. Without it nobody reports a
            sub-goal as done, so plans end by failures or ``replan_every``.
        plus: PS+: also ask for quantities and intermediate results.
        one_call: the paper's form for questions: plan and solution in one completion; free text only.
        replan_every: steps after which a new plan is made (0: never for this reason).
        replan_failures: failed actions in a row after which a new plan is made (0: never for this reason).
        max_goals: sub-goals asked for.
        plan_tokens: most tokens of a plan.
        feedback_tokens: budget of the failures that the planner is shown.
        thought_tokens: most tokens of a step's words (``None``: the spec's ``max_tokens``).
    """

    declaration = Declaration(
        "a plan of sub-goals that persists, then one sub-goal at a time; plans anew when it fails or is done",
        calls=CallProfile(step=(1, 3)),
        rl=CallProfile(step=(1, 2)),
        purposes=Purpose.each("step", "plan", "think", "act"),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        think: bool | None = None,
        plus: bool = True,
        one_call: bool = False,
        replan_every: int = 0,
        replan_failures: int = 2,
        max_goals: int = 5,
        plan_tokens: int | None = None,
        feedback_tokens: int = 128,
        thought_tokens: int | None = None,
    ) -> None:
        chosen = settings("plan_and_solve", PRESETS, preset, {"think": think, "plan_tokens": plan_tokens})
        at_least("plan_and_solve", 0, replan_every=replan_every, replan_failures=replan_failures)
        at_least("plan_and_solve", 1, max_goals=max_goals, plan_tokens=chosen["plan_tokens"])
        self.services = services
        self.think: bool = chosen["think"]
        self.one_call = one_call
        self.request = PLAN.format(most=max_goals) + (PLAN_PLUS if plus else "")
        self.replan_every = replan_every
        self.replan_failures = replan_failures
        self.max_goals = max_goals
        self.plan_tokens: int = chosen["plan_tokens"]
        self.feedback_tokens = feedback_tokens
        self.limit: dict[str, Any] = {} if thought_tokens is None else {"max_tokens": thought_tokens}
        self._reset()

    def _reset(self) -> None:
        self._plan: str | None = None
        self._goals: list[str] = []
        self._at = 0
        self._age = 0
        self._failures: list[str] = []

    def begin_episode(self, task: Task) -> None:
        self._reset()

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        if self.one_call and not input.action_schema.choices:
            return await self._plan_and_solve_at_once(input, recall)
        static = static_prompt(input, ON_REQUEST)
        dynamic = user_turn(input, recall, self.services)
        why = self._reason_to_plan()
        made: LLMCall | None = None
        if why is not None:
            made = await self._make_plan(static, dynamic, why)
            follow_up = self._request(input)
            messages = self.services.context.think((sampled(made),), follow_up)
        else:
            messages = self._with_plan(static, dynamic, self._request(input))
        return await self._solve(input, messages, made, why)

    def _reason_to_plan(self) -> str | None:
        """Why a plan is due: ``""`` for the first one, ``None`` if none is."""
        if self._plan is None:
            return ""
        if self.replan_failures and len(self._failures) >= self.replan_failures:
            return "failed"
        if self._at >= len(self._goals):
            return "is carried out"
        return "is old" if self.replan_every and self._age >= self.replan_every else None

    async def _make_plan(self, static: str, dynamic: str, why: str) -> LLMCall:
        """Ask for a plan and take it over; an empty answer leaves the whole task as the only sub-goal."""
        request = self.request
        if why:
            failures = "; ".join(self._failures)
            shown = (
                f"What failed: {clip(failures, self.feedback_tokens, self.services, keep='tail')}. " if failures else ""
            )
            request = f"{REPLAN.format(why=why, failures=shown)}\n{request}"
        messages = self.services.context.prompt(static, f"{dynamic}\n\n{request}")
        call = await self.services.llm.generate("plan", messages, max_tokens=self.plan_tokens)
        self._plan = call.text.strip()
        goals = [goal.strip() for goal in _NUMBERED.findall(self._plan)] or [" ".join(self._plan.split())[:200]]
        self._goals = [goal or "the task as a whole" for goal in goals][: self.max_goals]
        self._at = self._age = 0
        self._failures = []
        return call

    def _with_plan(self, static: str, dynamic: str, request: str) -> tuple[Message, ...]:
        """This step's prompt; the plan is written out unless the conversation still holds it."""
        messages = self.services.context.prompt(static, f"{dynamic}\n\n{request}")
        if not self._plan or any(self._plan in m.text for m in messages):
            return messages
        shown = SHOW_PLAN.format(plan=self._plan)
        return self.services.context.prompt(static, f"{shown}\n\n{dynamic}\n\n{request}")

    def _request(self, input: AgentInput) -> str:
        place = {"number": self._at + 1, "goal": self._goals[self._at]}
        if not input.action_schema.choices:
            return SOLVE_FREE.format(**place)
        if self.think:
            return THINK_MENU.format(**place)
        return f"{ACT_MENU.format(**place)} {default_answer(input.action_schema)}"

    async def _solve(
        self, input: AgentInput, messages: tuple[Message, ...], made: LLMCall | None, why: str | None
    ) -> Decision:
        schema = input.action_schema
        calls = [] if made is None else [(made.id, 0)]
        words = ""
        if schema.choices:
            if self.think:
                thought = await self.services.llm.generate("think", messages, **self.limit)
                words = thought.text
                calls.append((thought.id, 0))
                messages = self.services.context.think((sampled(thought),), default_answer(schema))
            action, call = await ask_action(self.services, messages, schema)
        else:
            call = await self.services.llm.generate("act", messages, **self.limit)
            words = call.text
            action = read_action(call.text, schema)
        goal = self._goals[self._at]
        trace: dict[str, Any] = {
            "method": "plan_and_solve",
            "plan": self._plan,
            "sub_goal": self._at + 1,
            **({} if why is None else {"planned": why or "first"}),
        }
        if _DONE.search(words):
            self._at += 1
        valid = isinstance(action, Action)
        return Decision(
            action,
            rationale=words or goal,
            calls=(*calls, (call.id, 0)),
            valid=valid,
            turn=(sampled(call),),
            trace=trace if valid else {**trace, "fallback": "nothing parsed"},
        )

    async def _plan_and_solve_at_once(self, input: AgentInput, recall: Recall) -> Decision:
        dynamic = user_turn(input, recall, self.services)
        messages = self.services.context.prompt(static_prompt(input, ONE_CALL), dynamic)
        call = await self.services.llm.generate("act", messages, **self.limit)
        action = read_action(call.text, input.action_schema)
        valid = isinstance(action, Action)
        trace: dict[str, Any] = {"method": "plan_and_solve"} | ({} if valid else {"fallback": "nothing parsed"})
        return Decision(
            action, rationale=call.text, calls=((call.id, 0),), valid=valid, turn=(action.text,), trace=trace
        )

    async def observe(self, transition: Transition) -> None:
        self._age += 1
        error = transition.info.get("error")
        if error or transition.info.get("invalid"):
            self._failures.append(f"{transition.action_text[:80]}: {error or 'had no effect'}")
        else:
            self._failures = []

    def snapshot(self) -> bytes:
        return dump_state([self._plan, self._goals, self._at, self._age, self._failures])

    def restore(self, blob: bytes) -> None:
        self._plan, self._goals, self._at, self._age, self._failures = load_state(blob)
