"""Plan-and-Solve (Wang et al., 2023): understand the task and devise a plan, then carry it out.

The paper asks for both in one completion, anew for every question, and that is the default here: each step plans from
where things stand and ends with the plan's first action. One call per step and some 1.6 times the output of a bare
chain; in menu mode one call for plan and reasoning and one constrained choice.

`persistent` is the form for agents whose plans shall outlive a step: a numbered list of sub-goals is made once, and
every step works on the current one. A step that reports its sub-goal as done moves on to the next. A new plan is made
when the plan is carried out, after `replan_failures` failed actions in a row (the planner is shown them), on news (the
environment reports one of `replan_on` among its `events`), or every `replan_every` steps; and no plan is made before
there is anything to see. One call per step, and one per plan.

In the `conversation` layout a persistent plan and the planner's request are turns of the conversation, exactly as
sampled, so an episode stays one token sequence; the plan is shown again when the conversation no longer holds it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message
from agentspec.parameters import at_least, settings, without_effect
from agentspec.prompting import (
    MAX_RETRIES,
    MENU_ANSWER,
    ON_REQUEST,
    Acted,
    ask_action,
    clip,
    default_answer,
    in_private,
    sampled,
    static_prompt,
    user_turn,
)
from agentspec.reasoning.plan_text import goals_of, says_done
from agentspec.services import Services
from agentspec.state import dump_state, load_state
from agentspec.types import AgentInput, Decision, LLMCall, Recall, Task, Transition
from agentspec.visible import visible

PRESETS = {
    "paper": {"persistent": False, "think": True, "plan_tokens": 512},
    "rl": {"persistent": True, "think": False, "plan_tokens": 96},
}
NEWS = ("new_offer", "new_offers", "delivered", "failed", "depleted", "hospital", "out_of_money", "charge_done")
"""Events that call for a new plan by default; having come where one wanted to go is none."""

TOGETHER = "First understand the task and where things stand, and devise a plan.{plus} Then carry out its first step: "
TOGETHER_FREE = "end with one line of the form\nAction: NAME(arguments)"
TOGETHER_MENU = "say in a sentence what it comes to; do not name the action yet."
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
SHOW_PLAN = "Plan:\n{plan}"


class PlanAndSolve:
    """Planning before acting.

    Args:
        preset: `paper` (plan and solution together, every step) or `rl` (a persistent short plan, and steps that in
            menu mode act without further words).
        persistent: make a plan once and keep it.
        plus: PS+: also ask for quantities and intermediate results.
        max_retries: further calls for an answer that holds no action.
        thought_tokens: most tokens of a step's words (`None`: the spec's `max_tokens`).
        think: persistent, menu mode: work the step out in words before the constrained choice. Without it nobody
            reports a sub-goal as done, so plans end by failures, news or `replan_every`.
        replan_every: steps after which a new plan is made (0: never for this reason).
        replan_failures: failed actions in a row after which a new plan is made (0: never for this reason).
        replan_on: names of events of the environment after which a new plan is made.
        max_goals: sub-goals asked for.
        plan_tokens: most tokens of a persistent plan.
        feedback_tokens: budget of the failures that the planner is shown.
    """

    declaration = Declaration(
        "plans and solves in one answer; or keeps a plan of sub-goals until news or failures call for another",
        calls=CallProfile(step=(1, 4)),
        rl=CallProfile(step=(1, 4)),
        purposes={
            "plan": Purpose("step", "1. Take an order\n2. Deliver it"),
            "think": Purpose("step"),
            "act": Purpose("step"),
        },
        small=({"persistent": True, "think": True, "replan_every": 4}, {"persistent": False, "think": True}),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        persistent: bool | None = None,
        plus: bool = True,
        max_retries: int = MAX_RETRIES,
        thought_tokens: int | None = None,
        think: bool | None = None,
        replan_every: int = 0,
        replan_failures: int = 2,
        replan_on: Sequence[str] = NEWS,
        max_goals: int = 5,
        plan_tokens: int | None = None,
        feedback_tokens: int = 128,
    ) -> None:
        given = {"persistent": persistent, "think": think, "plan_tokens": plan_tokens}
        chosen = settings("plan_and_solve", PRESETS, preset, given)
        if not chosen["persistent"]:
            without_effect(
                "plan_and_solve",
                "persistent: true",
                think=think is False,
                replan_every=replan_every != 0,
                replan_failures=replan_failures != 2,
                replan_on=tuple(replan_on) != NEWS,
                max_goals=max_goals != 5,
                plan_tokens=plan_tokens is not None,
                feedback_tokens=feedback_tokens != 128,
            )
        at_least("plan_and_solve", 0, replan_every=replan_every, replan_failures=replan_failures)
        at_least("plan_and_solve", 0, max_retries=max_retries)
        at_least("plan_and_solve", 1, max_goals=max_goals, plan_tokens=chosen["plan_tokens"])
        self.services = services
        self.persistent: bool = chosen["persistent"]
        self.think: bool = chosen["think"]
        self.together = TOGETHER.format(plus=PLAN_PLUS if plus else "")
        self.request = PLAN.format(most=max_goals) + (PLAN_PLUS if plus else "")
        self.max_retries = max_retries
        self.replan_every = replan_every
        self.replan_failures = replan_failures
        self.replan_on = frozenset(replan_on)
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
        self._news = ""

    def begin_episode(self, task: Task) -> None:
        self._reset()

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        dynamic = user_turn(input, recall, self.services)
        if not self.persistent:
            return await self._plan_and_solve(input, dynamic)
        static = static_prompt(input, ON_REQUEST)
        why = self._reason_to_plan(input)
        made: LLMCall | None = None
        if why is not None:
            made = await self._make_plan(static, dynamic, why)
            messages: Sequence[Message] = self.services.context.think((sampled(made),), self._request(input))
        else:
            messages = self._with_plan(static, dynamic, self._request(input))
        return await self._solve(input, messages, made, why)

    # -- plan and solution together ---------------------------------------------------------------------------------

    async def _plan_and_solve(self, input: AgentInput, dynamic: str) -> Decision:
        schema, menu = input.action_schema, bool(input.action_schema.choices)
        static = static_prompt(input, self.together + (TOGETHER_MENU if menu else TOGETHER_FREE))
        messages: Sequence[Message] = self.services.context.prompt(static, dynamic)
        calls: tuple[tuple[int, int], ...] = ()
        words = ""
        if menu:
            thought = await self.services.llm.generate("think", messages, **self.limit)
            calls, words = ((thought.id, 0),), thought.text
            messages = in_private(messages, sampled(thought), MENU_ANSWER)
        acted = await self._act(input, messages, in_private)
        trace: dict[str, Any] = {"method": "plan_and_solve"} | ({} if acted.valid else {"fallback": "nothing parsed"})
        return Decision(
            acted.action,
            rationale=words or acted.call.text,
            calls=(*calls, *acted.calls),
            valid=acted.valid,
            turn=(sampled(acted.call),) if schema.choices else (acted.action.text,),
            trace=trace,
        )

    async def _act(self, input: AgentInput, messages: Sequence[Message], follow_up: Any = None) -> Acted:
        limit = {} if input.action_schema.choices else self.limit
        return await ask_action(
            self.services, messages, input.action_schema, max_retries=self.max_retries, follow_up=follow_up, **limit
        )

    # -- a plan that persists ---------------------------------------------------------------------------------------

    def _reason_to_plan(self, input: AgentInput) -> str | None:
        """Why a plan is due: `""` for the first one, `None` if none is."""
        if self._plan is None:
            return "" if something_to_see(input.state) or self._age else None
        if self.replan_failures and len(self._failures) >= self.replan_failures:
            return "failed"
        if self._at >= len(self._goals):
            return "is carried out"
        if self._news:
            return f"was made before this: {self._news}"
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
        self._plan = visible(call.text)[0]
        goals = goals_of(self._plan) or [" ".join(self._plan.split())[:200] or "the task as a whole"]
        self._goals = goals[: self.max_goals]
        self._at = self._age = 0
        self._failures, self._news = [], ""
        return call

    def _with_plan(self, static: str, dynamic: str, request: str) -> tuple[Message, ...]:
        """This step's prompt; the plan is written out unless the conversation still holds it."""
        messages = self.services.context.prompt(static, f"{dynamic}\n\n{request}")
        if not self._plan or any(self._plan in m.text for m in messages):
            return messages
        shown = SHOW_PLAN.format(plan=self._plan)
        return self.services.context.prompt(static, f"{shown}\n\n{dynamic}\n\n{request}")

    def _request(self, input: AgentInput) -> str:
        menu = bool(input.action_schema.choices)
        if self._plan is None:
            how = default_answer(input.action_schema)
            return how if menu and not self.think else self.together + (TOGETHER_MENU if menu else TOGETHER_FREE)
        place = {"number": self._at + 1, "goal": self._goals[self._at]}
        if not menu:
            return SOLVE_FREE.format(**place)
        if self.think:
            return THINK_MENU.format(**place)
        return f"{ACT_MENU.format(**place)} {default_answer(input.action_schema)}"

    async def _solve(
        self, input: AgentInput, messages: Sequence[Message], made: LLMCall | None, why: str | None
    ) -> Decision:
        calls = [] if made is None else [(made.id, 0)]
        words = ""
        if input.action_schema.choices and self.think:
            thought = await self.services.llm.generate("think", messages, **self.limit)
            words = thought.text
            calls.append((thought.id, 0))
            messages = self.services.context.think((sampled(thought),), MENU_ANSWER)
        acted = await self._act(input, messages)
        words = words or ("" if input.action_schema.choices else acted.call.text)
        goal = self._goals[self._at] if self._plan is not None else ""
        trace: dict[str, Any] = {
            "method": "plan_and_solve",
            "plan": self._plan,
            "sub_goal": self._at + 1,
            **({} if why is None else {"planned": why or "first"}),
        }
        if self._plan is not None and says_done(words):
            self._at += 1
        return Decision(
            acted.action,
            rationale=words or goal,
            calls=(*calls, *acted.calls),
            valid=acted.valid,
            turn=(sampled(acted.call),),
            trace=trace if acted.valid else {**trace, "fallback": "nothing parsed"},
        )

    async def observe(self, transition: Transition) -> None:
        self._age += 1
        info = transition.info
        error = info.get("error")
        if error or info.get("invalid"):
            self._failures.append(f"{transition.action_text[:80]}: {error or 'had no effect'}")
        else:
            self._failures = []
        news = [str(event) for event in info.get("events") or () if event in self.replan_on]
        self._news = self._news or ", ".join(dict.fromkeys(news))

    def snapshot(self) -> bytes:
        return dump_state([self._plan, self._goals, self._at, self._age, self._failures, self._news])

    def restore(self, blob: bytes) -> None:
        self._plan, self._goals, self._at, self._age, self._failures, self._news = load_state(blob)


def something_to_see(state: Mapping[str, Any]) -> bool:
    """Whether a state shows anything to plan for: it has no lists of offers and orders, or one of them is not empty."""
    known = [state[key] for key in ("offers", "orders") if key in state]
    return not known or any(known)
