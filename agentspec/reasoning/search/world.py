"""The two worlds a search can move in: the environment itself, and the model's idea of it.

Both take a node's parent state and action to an `Outcome`. The environment is exact and is put back by its
user; the model predicts in words what would be observed, and whether the task would be accomplished, or over without
that.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from agentspec.llm.base import Message
from agentspec.prompting import Step, course, with_request
from agentspec.protocols import Services, Simulator
from agentspec.reasoning.search.judge import last_amount
from agentspec.reasoning.search.meter import Meter
from agentspec.reasoning.search.tree import Node
from agentspec.types import ActionSchema, AgentInput
from agentspec.visible import visible

PREDICT = (
    "Nobody acts now; imagine. What would be observed after the last step above? Write the new situation in at most "
    "three short sentences: only what changes, and the numbers that matter. Then write two last lines: 'Earned: ' and "
    "what this step itself would pay or cost as a number, and 'Goal: yes' if the task would be accomplished by then, "
    "'Goal: over' if it would have ended without that, otherwise 'Goal: no'."
)
STEPS = "Steps tried in thought from here:\n{steps}"

_EARNED = re.compile(r"^\W*earned\b.*$", re.IGNORECASE | re.MULTILINE)
_GOAL = re.compile(r"\bgoal\W{0,4}(yes|no|over)\b", re.IGNORECASE)


@dataclass(frozen=True)
class Outcome:
    """What an action leads to.

    Args:
        state: what the world needs to go on from here (environment: a snapshot; model: nothing).
        text: what is observed.
        schema: actions there; in an imagined state the last known ones.
        reward: reward of the step (model: 1 if the goal is reached, else 0).
        ended: nothing follows.
        success: whether an ended state is a success; `None` if the world does not say.
        earned: what the step pays in the environment's unit, as far as the world says.
    """

    state: Any
    text: str
    schema: ActionSchema
    reward: float = 0.0
    ended: bool = False
    success: bool | None = None
    earned: float = 0.0


class World(Protocol):
    """Where a search tries its steps. `real`: in the environment itself."""

    real: bool

    async def step(self, node: Node) -> Outcome:
        """What `node`'s action leads to; the parent's `state` is an outcome (or the root's)."""
        ...


class RealWorld:
    """The episode's environment, through its simulator."""

    real = True

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator

    async def step(self, node: Node) -> Outcome:
        assert node.parent is not None
        await self._simulator.restore(node.parent.state.state)
        seen = await self._simulator.step(node.action)
        blob = b"" if seen.ended else await self._simulator.snapshot()
        success = seen.info.get("success")
        return Outcome(
            blob,
            _told(seen.info, seen.input.text),
            seen.input.action_schema,
            seen.reward,
            seen.ended,
            None if success is None else bool(success),
            seen.reward,
        )


class ModelWorld:
    """The model predicts observations.

    Args:
        base: prompt that ends with the current observation.
        tokens: most tokens of a prediction, and of the steps shown before it.
        sampling: further sampling overrides.
    """

    real = False

    def __init__(
        self,
        meter: Meter,
        services: Services,
        base: Sequence[Message],
        *,
        tokens: int,
        path_tokens: int,
        **sampling: Any,
    ) -> None:
        self._meter = meter
        self._services = services
        self._base = base
        self._sampling = {"max_tokens": tokens, **sampling}
        self._path_tokens = path_tokens

    async def step(self, node: Node) -> Outcome:
        assert node.parent is not None
        request = f"{render_steps(node, self._services, self._path_tokens)}\n\n{PREDICT}"
        call = await self._meter.ask("world", with_request(self._base, request), **self._sampling)
        said = visible(call.text)[0]
        verdicts = _GOAL.findall(said)
        verdict = verdicts[-1].casefold() if verdicts else "no"
        reached, ended = verdict == "yes", verdict != "no"
        text = _EARNED.sub("", _GOAL.sub("", said)).strip() or "nothing that could be foreseen"
        schema, earned = node.parent.state.schema, last_amount(said, "earned") or 0.0
        return Outcome(None, text, schema, float(reached), ended, reached if ended else None, earned)


def _told(info: Mapping[str, Any], text: str) -> str:
    """An observation with what its action did, or why it failed, in front: at the end it would be cut first."""
    said = str(info.get("error") or info.get("message") or "").strip()
    if not said or said in text[: len(said) + 40]:
        return text
    return f"{said}\n\n{text}"


def root_outcome(input: AgentInput, blob: bytes | None) -> Outcome:
    """The state that a search starts from."""
    return Outcome(blob, input.text, input.action_schema)


def render_steps(node: Node, services: Services, budget: int) -> str:
    """The steps from the root to `node`: actions with their thoughts, and what was observed, within `budget`."""
    steps = [
        Step(step.action, getattr(step.note, "thought", "") or "", step.state.text if step.state is not None else "")
        for step in node.path[1:]
    ]
    return STEPS.format(steps=course(steps, budget, services)) if steps else ""
