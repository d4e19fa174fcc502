"""The players of RoboTHOR that the environment names: an oracle that knows the apartment, and chance."""

from __future__ import annotations

import inspect
import json
import random
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from agentspec.envs.experts import Chance
from agentspec.envs.robothor.env import CALLS, RoboThorEnv
from agentspec.envs.thor.scene import cell_at

Pose = tuple[float, float, float]


def _key(pose: Pose) -> tuple[Any, ...]:
    """Poses within 12 cm and of one heading count as one: turns of 30 degrees leave the grid."""
    return (round(8 * pose[0]), round(8 * pose[1]), round(pose[2]))


class Oracle:
    """Walks the fewest actions to a pose in which the target is in view, looks where it must, and stops.

    Searched breadth-first over poses, by the world's own moves: whatever the size of turns and steps.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        taken = inspect.signature(RoboThorEnv.__init__).parameters
        own = {"images": False, "render_mode": None, "player": "offline", "executable": ""}
        given = {k: v for k, v in options.items() if k in taken} | own
        self._env = RoboThorEnv(**given)
        self._plan: list[str] = []
        self._due: tuple[Any, ...] = ()

    def act(self, info: Mapping[str, Any]) -> str:
        """The next action of the plan; a new plan when something else was done."""
        state = info["state"]
        now = (state["seed"], state["steps_left"], state["x"], state["z"], state["yaw"], state["horizon"])
        if now[:2] != self._due:
            self._plan = self._search(state)
        call = self._plan.pop(0) if self._plan else "STOP"
        self._due = (state["seed"], state["steps_left"] - 1)
        return CALLS[call][1] if info["action_schema"].choices else f"{call}()"

    def _search(self, state: Mapping[str, Any]) -> list[str]:
        env = self._env
        if env.episode_seed != state["seed"]:
            env.reset(seed=state["seed"])
        world = env.world.boxes()
        agent = world.state.agent
        targets = [b for b in world.state.bodies.values() if b.type == env.episode.target]
        start = (state["x"], state["z"], state["yaw"])
        before: dict[Pose, tuple[Pose, str]] = {}
        queue, seen = deque([start]), {_key(start)}
        while queue:
            pose = queue.popleft()
            x, z, yaw = pose
            if any(world.near(cell_at(x, z), b) for b in targets):
                for looks in self._looks(state["horizon"]):
                    here = replace(agent, x=x, z=z, yaw=yaw, horizon=state["horizon"] + 30.0 * looks)
                    if any(world.sight.sees(b, here) for b in targets):
                        tail = ["LOOK_DOWN" if looks > 0 else "LOOK_UP"] * abs(looks)
                        return [*self._trace(pose, before), *tail, "STOP"]
            agent.horizon = state["horizon"]
            for call in ("MOVE_AHEAD", "ROTATE_RIGHT", "ROTATE_LEFT"):
                agent.x, agent.z, agent.yaw = pose
                world.try_move(CALLS[call][0])
                near = (agent.x, agent.z, agent.yaw)
                if _key(near) not in seen:
                    seen.add(_key(near))
                    before[near] = (pose, call)
                    queue.append(near)
        return ["STOP"]

    def _looks(self, horizon: float) -> list[int]:
        low, high = self._env.settings.horizon
        return [k for k in (0, 1, -1, 2, -2) if low <= horizon + 30.0 * k <= high]

    @staticmethod
    def _trace(pose: Pose, before: Mapping[Pose, tuple[Pose, str]]) -> list[str]:
        way = []
        while pose in before:
            pose, call = before[pose]
            way.append(call)
        return way[::-1]

    def snapshot(self) -> bytes:
        """The plan and the step it is for."""
        return json.dumps([self._plan, self._due]).encode()

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`."""
        plan, due = json.loads(blob)
        self._plan, self._due = list(plan), tuple(due)


def expert(options: Mapping[str, Any], rng: random.Random) -> Oracle:
    """The player `rule_based`."""
    return Oracle(options)


def luck(options: Mapping[str, Any], rng: random.Random) -> Chance:
    """The player `random`."""
    return Chance(rng, lambda info: info["action_schema"].choices or [f"{call}()" for call in CALLS])
