"""Reasoners without a model: the environment's scripted expert, and a random sensible action.

They mark the ceiling that rules reach and the floor, and the expert's episodes serve as demonstrations for a warm
start. Both answer in the environment's language: a choice of the menu where there is one, a native call otherwise. Who
plays is declared by the environment (see `agentspec.envs.experts`).
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

from agentspec.actions import parse_action
from agentspec.declaration import Declaration
from agentspec.envs.experts import NoPlayer, Player, player
from agentspec.protocols import Services
from agentspec.reasoning.common import Stateless
from agentspec.state import dump_random, load_random
from agentspec.types import Action, AgentInput, Decision, Recall, Task


def decision(text: str, input: AgentInput, rationale: str) -> Decision:
    """The decision for an action text."""
    action = parse_action(text, input.action_schema)
    return Decision(action, rationale=rationale, valid=isinstance(action, Action))


def _player(task: Task, role: str, rng: random.Random, parameters: Mapping[str, Any]) -> Player:
    return player(task.env, role, task.options, rng, **parameters)


class RuleBased(Stateless):
    """The scripted expert of the task's environment.

    Args:
        parameters: of the expert, as its environment documents them; for DeliveryBench `bagging` and `hasty`.
    """

    declaration = Declaration(
        "the environment's scripted expert: no model, a baseline and demonstrator",
        scripted=True,
        aliases=("simple",),
    )

    def __init__(self, services: Services, parameters: Mapping[str, Any] | None = None) -> None:
        self.services = services
        self.parameters = dict(parameters or {})
        self.player: Player | None = None

    def begin_episode(self, task: Task) -> None:
        """Ask the task's environment for its expert.

        Raises:
            NoPlayer: it has none.
        """
        self.player = _player(task, "rule_based", self.services.rng, self.parameters)

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        """The expert's next action.

        Raises:
            RuntimeError: before `begin_episode`.
        """
        if self.player is None:
            raise RuntimeError("rule_based: begin_episode(task) must come before decide(), it names the environment")
        text = self.player.act({"state": input.state, "action_schema": input.action_schema})
        return decision(text, input, "scripted expert")

    def snapshot(self) -> bytes:
        """What the expert remembers."""
        return b"" if self.player is None else self.player.snapshot()

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot` of the same episode."""
        if blob and self.player is not None:
            self.player.restore(blob)


class RandomLegal(Stateless):
    """A random action: of the menu where there is one, else of the environment's own player, else of the examples."""

    declaration = Declaration(
        "a random sensible action: no model, the floor",
        scripted=True,
        name="random",
    )

    def __init__(self, services: Services) -> None:
        self.services = services
        self.player: Player | None = None

    def begin_episode(self, task: Task) -> None:
        """Ask the task's environment for its random player, if it has one."""
        try:
            self.player = _player(task, "random", self.services.rng, {})
        except NoPlayer:
            self.player = None

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        """A uniform draw from the services' own generator."""
        schema = input.action_schema
        if schema.choices:
            return decision(self.services.rng.choice(schema.choices), input, "random")
        if self.player is not None:
            return decision(self.player.act({"state": input.state, "action_schema": schema}), input, "random")
        examples = [action.example for action in schema.actions.values() if action.example]
        if not examples:
            raise ValueError("random: this environment offers no menu, no random player and no examples of its actions")
        return decision(self.services.rng.choice(examples), input, "random")

    def snapshot(self) -> bytes:
        """The state of the generator."""
        return dump_random(self.services.rng)

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`."""
        load_random(self.services.rng, blob)
