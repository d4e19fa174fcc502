"""One step of the agent: perceive, recall, reason, revise; then learn what came of it.

The agent owns the order of things and nothing else. It credits the calls that produced the executed action, writes the
assistant's turn into the context, keeps the plan that an answer carried for the next prompt, and turns an exhausted
budget into a flagged decision instead of a crash. What a memory or a reflector cannot do (its prompt is too long for
the model, the budget is used up) is a counted no-op: the episode goes on without it.
"""

from __future__ import annotations

import base64
from collections.abc import Awaitable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

from agentspec.context import Context
from agentspec.llm.base import ContextOverflowError
from agentspec.llm.pictures import picture
from agentspec.llm.recorder import BudgetExceededError, Recorder
from agentspec.protocols import Measured, Memory, Perception, Reasoning, Reflection, Services, Simulator, StepClock
from agentspec.state import dump_state, load_state
from agentspec.types import Action, ActionError, AgentInput, Decision, LLMCall, Recall, Task, Transition

if TYPE_CHECKING:
    from agentspec.trajectory import Trajectory


T = TypeVar("T")


@dataclass
class Agent:
    """The composed agent of one episode; built by :meth:`agentspec.spec.AgentSpec.build`.

    `names` are the modules' names in call tags (`memory.base`), by kind.
    """

    perception: Perception
    memory: Memory
    reasoning: Reasoning
    reflection: Reflection
    context: Context
    clock: StepClock
    recorder: Recorder
    services: tuple[Services, ...] = ()
    names: Mapping[str, str] = field(default_factory=dict)
    _charged: int = 0

    def attach_simulator(self, simulator: Simulator | None) -> None:
        """Give every module the environment for search (``None``: it has no snapshots)."""
        for services in self.services:
            services.simulator = simulator

    def begin_episode(self, task: Task) -> None:
        """Prepare every module for ``task``."""
        self.clock.step = 0
        for module in (self.memory, self.reasoning, self.reflection):
            module.begin_episode(task)

    async def decide(
        self, task: Task, observation: Mapping[str, Any], info: Mapping[str, Any]
    ) -> tuple[AgentInput, Decision]:
        """u_t and r_t for one observation; the decision's calls are credited as executed.

        An exhausted budget gives a decision with an :class:`~agentspec.types.ActionError` of code ``BUDGET``.
        """
        self.recorder.step = self.clock.step
        agent_input = self.perception.perceive(task, observation, info)
        self.context.pictures = tuple(map(picture, agent_input.images))
        try:
            recall = await self._or("memory", self.memory.retrieve(agent_input), Recall())
            lessons = await self._or("reflection", self.reflection.lessons(agent_input), Recall())
            recall = Recall(lessons.items + recall.items)
            decision = await self.reasoning.decide(agent_input, recall)
            decision = await self._or("reflection", self.reflection.revise(agent_input, recall, decision), decision)
        except BudgetExceededError as error:
            decision = Decision(ActionError("BUDGET", str(error)), valid=False, trace={"budget": str(error)})
        for call_id, completion in decision.calls:
            self.recorder.credit(call_id, completion, "executed")
        self.context.close(decision.turn or (decision.action.text,))
        plan = decision.action.plan if isinstance(decision.action, Action) else ""
        if plan:
            self.context.plan = plan
            decision = replace(decision, trace={"plan": plan, **decision.trace})
        return agent_input, decision

    async def learn(self, transition: Transition) -> None:
        """Tell reasoning and memory what the executed action did; calls they make belong to the step that follows."""
        self.clock.step = self.recorder.step = transition.step + 1
        await self.reasoning.observe(transition)
        await self._or("memory", self.memory.store(transition), None, budget=True)

    async def end_episode(self, trajectory: Trajectory) -> None:
        """Let memory and reflection draw their conclusions."""
        await self._or("memory", self.memory.end_episode(trajectory), None, budget=True)
        await self._or("reflection", self.reflection.end_episode(trajectory), None, budget=True)

    def uncharged(self) -> list[LLMCall]:
        """The calls made since this was last asked: what an environment that charges for thinking has not seen yet.

        At a decision these are all of the step's own calls and what memory asked after the step before.
        """
        calls = self.recorder.calls[self._charged :]
        self._charged = len(self.recorder.calls)
        return calls

    async def _or(self, kind: str, work: Awaitable[T], otherwise: T, *, budget: bool = False) -> T:
        """What `work` gives; `otherwise` if its prompt is too long for the model, or (`budget`) the budget is used up.

        An exhausted budget passes through by default, so that the decision it happened in is flagged.
        """
        try:
            return await work
        except ContextOverflowError:
            problem = "overflow"
        except BudgetExceededError:
            if not budget:
                raise
            problem = "budget"
        self.recorder.problems[self.names.get(kind, kind), problem] += 1
        return otherwise

    def metrics(self) -> dict[str, Any]:
        """Figures that modules add to the trajectory's, as ``reflection/...``, ``reasoning/...``, ``memory/...``."""
        kinds = {"memory": self.memory, "reasoning": self.reasoning, "reflection": self.reflection}
        measured = {kind: module.metrics() for kind, module in kinds.items() if isinstance(module, Measured)}
        found = {f"{kind}/{name}": value for kind, figures in measured.items() for name, value in figures.items()}
        for (module, problem), count in sorted(self.recorder.problems.items()):
            found[f"{module.partition('.')[0]}/problems/{problem}"] = count
        return found

    def carry(self) -> bytes:
        """What outlives the episode under `scope: run`: time, ids, and the state of memory and of reflection."""
        states = {kind: base64.b64encode(m.snapshot()).decode() for kind, m in self._lasting()}
        return dump_state({"time": self.clock.carry(), **states})

    def resume(self, blob: bytes) -> None:
        """Take over what an earlier episode's agent carried."""
        data = load_state(blob)
        self.clock.resume(data["time"])
        for kind, module in self._lasting():
            module.restore(base64.b64decode(data[kind]))

    def _lasting(self) -> tuple[tuple[str, Memory | Reflection], ...]:
        return (("memory", self.memory), ("reflection", self.reflection))
