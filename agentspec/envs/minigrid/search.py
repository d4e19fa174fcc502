"""The shortest plan, by breadth-first search through the environment's own `step`.

Every rule (doors, keys, lava, what ends an episode) is therefore honoured by construction. Between steps the
environment is put back by `capture`, which remembers every mutable object in it; nothing is copied that cannot change.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium

ACTIONS = ("left", "right", "forward", "pickup", "drop", "toggle", "done")
"""MiniGrid's actions by number."""

_FIXED = frozenset({"Wall", "Lava", "Goal", "Floor", "MissionSpace"})
"""Classes of MiniGrid whose objects never change."""


def capture(world: Any) -> Callable[[], None]:
    """Remember the state of `world` (an unwrapped MiniGrid environment); calling the result puts it back.

    Followed are attributes, lists and dictionaries of MiniGrid's own objects; random generators are included.
    """
    objects: list[tuple[Any, dict[str, Any]]] = []
    lists: list[tuple[list[Any], list[Any]]] = []
    dicts: list[tuple[dict[Any, Any], dict[Any, Any]]] = []
    generator = getattr(world, "_np_random", None)
    state = None if generator is None else generator.bit_generator.state
    seen: set[int] = set()
    stack = [world]
    while stack:
        item = stack.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, list):
            lists.append((item, list(item)))
            stack.extend(v for v in item if _followed(v))
        elif isinstance(item, dict):
            dicts.append((item, dict(item)))
            stack.extend(v for v in item.values() if _followed(v))
        elif isinstance(item, tuple):
            stack.extend(v for v in item if _followed(v))
        else:
            objects.append((item, dict(vars(item))))
            stack.extend(v for v in vars(item).values() if _followed(v))

    def restore() -> None:
        for item, attributes in objects:
            vars(item).clear()
            vars(item).update(attributes)
        for kept, values in lists:
            kept[:] = values
        for mapping, entries in dicts:
            mapping.clear()
            mapping.update(entries)
        if generator is not None:
            generator.bit_generator.state = state

    return restore


def _followed(value: Any) -> bool:
    if isinstance(value, list | dict | tuple):
        return True
    kind = type(value)
    return kind.__module__.startswith("minigrid.") and kind.__name__ not in _FIXED and hasattr(value, "__dict__")


def state_key(world: Any) -> tuple[Any, ...]:
    """Equal for states that cannot be told apart: pose, grid, what is carried, progress of instructions."""
    cells = tuple(
        None if c is None else (id(c), *c.encode(), id(getattr(c, "contains", None))) for c in world.grid.grid
    )
    carried = None if world.carrying is None else id(world.carrying)
    return (*map(int, world.agent_pos), int(world.agent_dir), carried, cells, _progress(getattr(world, "instrs", None)))


def _progress(instruction: Any) -> tuple[Any, ...]:
    """What BabyAI's instructions remember of what was done."""
    if instruction is None:
        return ()
    own: list[tuple[str, Any]] = []
    for name, value in sorted(vars(instruction).items()):
        if isinstance(value, bool | str) or value is None:
            own.append((name, value))
        elif name in ("preCarrying", "lastStepMatch"):
            own.append((name, id(value)))
        elif name.startswith("instr_"):
            own.append((name, _progress(value)))
    return tuple(own)


def shortest_plan(world: Any, *, most_states: int = 200_000) -> list[int] | None:
    """Fewest actions from where `world` (unwrapped) stands to success; it is left untouched.

    Returns:
        numbers of the actions, or `None` where nothing leads to success within `most_states` states.
    """
    start = capture(world)
    world.gen_obs = lambda: None  # the search needs no views; putting the state back removes this
    world.max_steps = 10**9
    begin = capture(world)
    try:
        seen = {state_key(world)}
        queue: deque[tuple[Callable[[], None], list[int]]] = deque([(begin, [])])
        while queue and len(seen) < most_states:
            back, plan = queue.popleft()
            for action in range(len(ACTIONS)):
                back()
                _, reward, terminated, _, _ = world.step(action)
                if reward > 0:
                    return [*plan, action]
                if terminated:
                    continue
                key = state_key(world)
                if key not in seen:
                    seen.add(key)
                    queue.append((capture(world), [*plan, action]))
        return None
    finally:
        start()


@functools.lru_cache(maxsize=65_536)
def start_of(id: str, seed: int) -> str:
    """Level, and a digest of what an episode on layout `seed` starts with: equal for seeds that start the same one.

    Grid (what boxes hold included), position, heading and mission. Where obstacles move by chance the seed is a part of
    it. Takes about half a millisecond.
    """
    import minigrid  # noqa: F401  (registers its environments)

    env = gymnasium.make(id, disable_env_checker=True)
    try:
        env.reset(seed=seed)
        world: Any = env.unwrapped
        cells = [_contents(cell) for cell in world.grid.grid]
        place = (world.grid.width, *map(int, world.agent_pos), int(world.agent_dir))
        chance = seed if hasattr(world, "obstacles") else None
        told = json.dumps((cells, place, str(world.mission), chance))
    finally:
        env.close()
    return f"{id}:{hashlib.sha256(told.encode()).hexdigest()[:16]}"


def _contents(cell: Any) -> list[Any] | None:
    """What stands in a cell, and what that holds: nested lists of MiniGrid's numbers of type, colour and state."""
    return None if cell is None else [*map(int, cell.encode()), _contents(getattr(cell, "contains", None))]


@functools.lru_cache(maxsize=256)
def actions_of(id: str) -> int:
    """How many of `ACTIONS` the registered environment `id` takes: Dynamic-Obstacles reads the others as turns."""
    import minigrid  # noqa: F401  (registers its environments)

    env = gymnasium.make(id, disable_env_checker=True)
    try:
        space: Any = env.action_space
        return min(len(ACTIONS), int(space.n))
    finally:
        env.close()


@functools.lru_cache(maxsize=4096)
def optimum(id: str, seed: int, most_states: int = 200_000) -> int | None:
    """Fewest actions that solve layout `seed` of the registered environment `id`.

    `None` if none was found, and where obstacles move by chance: a plan is then as short as luck has it.
    """
    import minigrid  # noqa: F401  (registers its environments)

    env = gymnasium.make(id, disable_env_checker=True)
    try:
        env.reset(seed=seed)
        if hasattr(env.unwrapped, "obstacles"):
            return None
        plan = shortest_plan(env.unwrapped, most_states=most_states)
    finally:
        env.close()
    return None if plan is None else len(plan)
