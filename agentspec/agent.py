"""One step of the agent: perceive, recall, reason, revise; then learn what came of it.

The agent owns the order of things and nothing else. It credits the calls that produced the executed action, writes the
assistant's turn into the context and turns an exhausted budget into a flagged decision instead of a crash.
"""

from __future__ import annotations

import base64
import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from agentspec.context import Context
from agentspec.llm.recorder import BudgetExceededError, Recorder
from agentspec.protocols import (
    Measured,
    Memory,
    Perception,
    Reasoning,
    Reflection,
    Services,
    Simulator,
    StepClock,
)
from agentspec.state import dump_state, load_state
from agentspec.types import ActionError, AgentInput, Decision, Recall, Task, Transition

if TYPE_CHECKING:
    from agentspec.trajectory import Trajectory


@dataclass
class Agent:
    """The composed agent of one episode; built by :meth:`agentspec.spec.AgentSpec.build`."""

    perception: Perception
    memory: Memory
    reasoning: Reasoning
    reflection: Reflection
    context: Context
    clock: StepClock
    recorder: Recorder
    services: tuple[Services, ...] = ()

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
        try:
            recall = await self.memory.retrieve(agent_input)
            lessons = await self.reflection.lessons(agent_input)
            recall = Recall(lessons.items + recall.items)
            decision = await self.reasoning.decide(agent_input, recall)
            decision = await self.reflection.revise(agent_input, recall, decision)
        except BudgetExceededError as error:
            decision = Decision(ActionError("BUDGET", str(error)), valid=False, trace={"budget": str(error)})
        for call_id, completion in decision.calls:
            self.recorder.credit(call_id, completion, "executed")
        self.context.close(decision.turn or (decision.action.text,))
        return agent_input, decision

    async def learn(self, transition: Transition) -> None:
        """Tell reasoning and memory what the executed action did."""
        await self.reasoning.observe(transition)
        # A memory write that the budget does not allow is a no-op; the next decision is flagged.
        with contextlib.suppress(BudgetExceededError):
            await self.memory.store(transition)
        self.clock.step = transition.step + 1

    async def end_episode(self, trajectory: Trajectory) -> None:
        """Let memory and reflection draw their conclusions."""
        for module in (self.memory, self.reflection):
            with contextlib.suppress(BudgetExceededError):
                await module.end_episode(trajectory)

    def metrics(self) -> dict[str, Any]:
        """Figures that modules add to the trajectory's, as ``reflection/...``, ``reasoning/...``, ``memory/...``."""
        kinds = {"memory": self.memory, "reasoning": self.reasoning, "reflection": self.reflection}
        measured = {kind: module.metrics() for kind, module in kinds.items() if isinstance(module, Measured)}
        return {f"{kind}/{name}": value for kind, figures in measured.items() for name, value in figures.items()}

    def carry(self) -> bytes:
        """What outlives the episode under ``scope: run``: the state of memory and of reflection."""
        return dump_state([base64.b64encode(m.snapshot()).decode() for m in (self.memory, self.reflection)])

    def resume(self, blob: bytes) -> None:
        """Take over what an earlier episode's agent carried."""
        for module, state in zip((self.memory, self.reflection), load_state(blob), strict=True):
            module.restore(base64.b64decode(state))
