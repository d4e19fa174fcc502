"""The players that the environment names (see `agentspec.envs.experts`): the shortest plan, and chance.

The expert sees the whole grid: it sets up the layout that `info["state"]` names, plays the actions so far, and searches
from there. It is the upper reference for success and efficiency, and the demonstrator of warm starts; a player that has
to find its way cannot always be as short. In the suite `practice` it first turns to what a player must have seen in
order to choose (the object of Memory's start room): to copy a player that just knows would be to learn guessing.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import minigrid  # noqa: F401  (registers its environments)

from agentspec.envs.experts import Chance
from agentspec.envs.minigrid.env import CALLS, NO_ACTION
from agentspec.envs.minigrid.search import shortest_plan


class ShortestPlan:
    """Follows a shortest plan, and searches anew when something else was done."""

    def __init__(self, most_states: int = 200_000, look: bool = False) -> None:
        self._most_states = most_states
        self._look = look
        self._done: list[int] = []
        self._plan: list[int] = []

    def act(self, info: Mapping[str, Any]) -> str:
        """The next action of a shortest plan; the last one ("done") where nothing leads to success any more."""
        state = info["state"]
        history = [int(a) for a in state["history"]]
        if history != self._done or not self._plan:
            self._plan = self._search(state["layout"], history)
        calls, phrases = info["action_schema"].actions, info["action_schema"].choices
        action = self._plan.pop(0) if self._plan else len(calls) - 1
        self._done = [*history, action]
        return phrases[action] if phrases else f"{list(CALLS)[action]}()"

    def _search(self, layout: Mapping[str, Any], history: list[int]) -> list[int]:
        env = gymnasium.make(layout["id"], disable_env_checker=True)
        try:
            env.reset(seed=layout["seed"])
            world: Any = env.unwrapped
            world.max_steps = 10**9
            turns = _turns_to_see(world) if self._look else []
            for action in history:
                if action != NO_ACTION:
                    world.step(action)
                turns = turns and _turns_to_see(world)
            for action in turns:
                world.step(action)
            return [*turns, *(shortest_plan(world, most_states=self._most_states) or [])]
        finally:
            env.close()

    def snapshot(self) -> bytes:
        """What was done, and what is planned."""
        return json.dumps([self._done, self._plan]).encode()

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`."""
        self._done, self._plan = json.loads(blob)


def _turns_to_see(world: Any) -> list[int]:
    """The fewest turns after which Memory's cue is in view; none in other levels, or where turning does not help."""
    if not hasattr(world, "success_pos"):
        return []
    heading, cue = world.agent_dir, (1, world.height // 2 - 1)
    try:
        for turns in ([], [0], [1], [0, 0]):
            world.agent_dir = (heading + sum(2 * turn - 1 for turn in turns)) % 4
            if world.agent_sees(*cue):
                return turns
        return []
    finally:
        world.agent_dir = heading


def expert(
    options: Mapping[str, Any], rng: random.Random, most_states: int = 200_000, look: bool | None = None
) -> ShortestPlan:
    """The player `rule_based`; `most_states` bounds each search, `look` is on in the suite `practice`."""
    return ShortestPlan(most_states, options.get("suite") == "practice" if look is None else look)


def luck(options: Mapping[str, Any], rng: random.Random) -> Chance:
    """The player `random`."""
    return Chance(rng, _offered)


def _offered(info: Mapping[str, Any]) -> Sequence[str]:
    """Any of the seven actions."""
    schema = info["action_schema"]
    return schema.choices or [f"{name}()" for name in schema.actions]
