"""What the expert would note of a grid: what decides in Memory levels once it was seen, and what came in view.

See `agentspec.demonstration`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import gymnasium
import minigrid  # noqa: F401  (registers its environments)

from agentspec.envs.minigrid.env import NO_ACTION
from agentspec.types import AgentInput

THING = re.compile(r"(?:In view: |; |In front: |carrying )((?:(?:open|closed|locked) )?[a-z]+ (?:key|ball|box|door))")


def notes(inputs: Sequence[AgentInput]) -> list[str]:
    """Sentences about what was seen, newest last."""
    if not inputs:
        return []
    first: dict[str, int] = {}
    for step, seen in enumerate(inputs, 1):
        for thing in THING.findall(seen.text):
            first.setdefault(thing, step)
    found = cue(inputs[-1])
    noted = [f"The object of the start room is a {found}."] if found else []
    if first:
        noted.append(f"Seen: {', '.join(f'{thing} (step {step})' for thing, step in first.items())}.")
    last = [line for line in inputs[-1].text.splitlines() if line.startswith("Last:")]
    return [*noted, *last]


def cue(input: AgentInput) -> str:
    """In Memory levels the object whose like is to be found at a hallway's end, once it was in view; else empty."""
    layout = input.state.get("layout")
    if not layout or "-Memory" not in layout["id"]:
        return ""
    env = gymnasium.make(layout["id"], disable_env_checker=True)
    try:
        env.reset(seed=layout["seed"])
        world: Any = env.unwrapped
        place = (1, world.height // 2 - 1)
        seen = world.agent_sees(*place)
        for action in input.state["history"]:
            if action != NO_ACTION:
                world.step(int(action))
            seen = seen or world.agent_sees(*place)
        thing = world.grid.get(*place)
        return f"{thing.color} {thing.type}" if seen and thing else ""
    finally:
        env.close()
