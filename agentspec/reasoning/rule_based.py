"""Reasoners without a model: DeliveryBench's scripted expert, and a random sensible action.

They mark the ceiling that rules reach and the floor, and the expert's episodes serve as demonstrations for a warm
start. Both answer in the environment's language: a choice of the menu where there is one, a native call otherwise.
"""

from __future__ import annotations

from agentspec.declaration import Declaration
from agentspec.actions import parse_action
from agentspec.envs.deliverybench.courier import RandomCourier, RuleBasedCourier, Style
from agentspec.envs.deliverybench.env import city_of
from agentspec.protocols import Services
from agentspec.reasoning.common import Stateless
from agentspec.types import Action, AgentInput, Decision, Recall, Task

CITY_OPTIONS = ("map", "size", "city_seed")


def decision(text: str, input: AgentInput, rationale: str) -> Decision:
    """The decision for an action text."""
    action = parse_action(text, input.action_schema)
    return Decision(action, rationale=rationale, valid=isinstance(action, Action))


class RuleBased(Stateless):
    """The rule-based courier of DeliveryBench (see `agentspec.envs.deliverybench.courier`).

    Args:
        bagging: pack food into the bag after every pick-up.
        hasty: move at the accelerated pace while nothing fragile is carried.
    """

    declaration = Declaration(
        "the environment's scripted expert: no model, a baseline and demonstrator",
        envs=("deliverybench",),
        aliases=("simple",),
    )

    def __init__(self, services: Services, bagging: bool = True, hasty: bool = True) -> None:
        self.services = services
        self.style = Style(bagging=bagging, hasty=hasty)
        self.courier: RuleBasedCourier | None = None

    def begin_episode(self, task: Task) -> None:
        """Take the map of the task's city."""
        options = {name: task.options[name] for name in CITY_OPTIONS if name in task.options}
        self.courier = RuleBasedCourier(city_of(**options), self.style)

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        """The expert's next action.

        Raises:
            RuntimeError: before `begin_episode`.
        """
        if self.courier is None:
            raise RuntimeError("rule_based: begin_episode(task) must come before decide(), it names the city")
        text = self.courier.act({"state": input.state, "action_schema": input.action_schema})
        return decision(text, input, "insertion heuristic")

    def snapshot(self) -> bytes:
        """The round the courier is on."""
        return b"" if self.courier is None else self.courier.snapshot()

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot` of the same episode."""
        if blob and self.courier is not None:
            self.courier.restore(blob)


class RandomLegal(Stateless):
    """A random one of the actions that make sense now: of the menu where there is one, else of the menu's calls."""

    declaration = Declaration(
        "a random sensible action: no model, the floor",
        envs=("deliverybench",),
        name="random",
    )

    def __init__(self, services: Services) -> None:
        self.courier = RandomCourier(services.rng)

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        """A uniform draw from the services' own generator."""
        schema = input.action_schema
        if not schema.choices and "offers" not in input.state:
            raise ValueError("random: this environment offers neither a menu nor DeliveryBench's state; use menu mode")
        return decision(self.courier.act({"state": input.state, "action_schema": schema}), input, "random")

    def snapshot(self) -> bytes:
        """The state of the generator."""
        return self.courier.snapshot()

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`."""
        self.courier.restore(blob)
