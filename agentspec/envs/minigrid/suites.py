"""Which grids are played: the paper's ten tasks, suites where remembering decides, BabyAI levels, and practice.

A suite turns an episode's seed into a registered MiniGrid id and a layout seed. `paper` is the ten fixed layouts of the
AgentSpec paper (seed modulo ten selects one); the other suites cycle through their ids and use the seed for the layout.
`practice` is what to train on before playing `paper` or `memory`: their ids, with none of the ten layout seeds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from agentspec.actions import suggest


@dataclass(frozen=True)
class Layout:
    """One grid: registered id, layout seed, and the fewest actions that solve it where they are known."""

    id: str
    seed: int
    name: str = ""
    optimal: int | None = None


PAPER: tuple[Layout, ...] = (
    Layout("MiniGrid-Empty-6x6-v0", 42, "empty_6x6_seed42", 7),
    Layout("MiniGrid-GoToObject-6x6-N2-v0", 7, "goto_object_6x6_n2_seed7", 4),
    Layout("MiniGrid-GoToDoor-5x5-v0", 123, "goto_door_5x5_seed123", 5),
    Layout("MiniGrid-Fetch-5x5-N2-v0", 99, "fetch_5x5_n2_seed99", 5),
    Layout("MiniGrid-SimpleCrossingS9N1-v0", 42, "simple_crossing_s9n1_seed42", 14),
    Layout("MiniGrid-LavaCrossingS9N1-v0", 123, "lava_crossing_s9n1_seed123", 14),
    Layout("MiniGrid-MultiRoom-N2-S4-v0", 42, "multiroom_n2s4_seed42", 8),
    Layout("MiniGrid-LavaGapS5-v0", 42, "lava_gap_s5_seed42", 5),
    Layout("MiniGrid-FourRooms-v0", 42, "four_rooms_seed42", 26),
    Layout("MiniGrid-SimpleCrossingS9N2-v0", 123, "simple_crossing_s9n2_seed123", 14),
)
"""The ten tasks of the AgentSpec paper with their optima (actions, turns included), found by breadth-first search."""

MEMORY = ("MiniGrid-MemoryS7-v0", "MiniGrid-RedBlueDoors-6x6-v0", "MiniGrid-ObstructedMaze-1Dlh-v0")

SUITES: Mapping[str, tuple[str, ...]] = {
    "paper": tuple(layout.id for layout in PAPER),
    "memory": MEMORY,
    "practice": (*(layout.id for layout in PAPER), *MEMORY),
    "babyai": (
        "BabyAI-GoToObjS6-v1",
        "BabyAI-GoToLocalS5N2-v0",
        "BabyAI-PickupLoc-v0",
        "BabyAI-OpenDoor-v0",
        "BabyAI-PutNextS5N1-v0",
    ),
}
"""Suite -> the registered ids it cycles through."""


def layout_of(*, suite: str = "", level: str = "", task: str = "", seed: int = 0) -> Layout:
    """The grid of an episode.

    Args:
        suite: one of `SUITES`; the episode's `seed` selects the id, and except for `paper` the layout.
        level: a registered MiniGrid or BabyAI id; `seed` is the layout's.
        task: name of one of the paper's ten tasks; `seed` does not matter.

    Raises:
        ValueError: none of the three, several of them, or an unknown one.
    """
    given = [name for name, value in (("suite", suite), ("level", level), ("task", task)) if value]
    if len(given) != 1:
        found = " and ".join(given) or "neither suite, level nor task"
        raise ValueError(f"got {found}; expected one of suite, level, task")
    if task:
        named = {layout.name: layout for layout in PAPER}
        if task not in named:
            raise ValueError(f"unknown task {task!r}{suggest(task, named)}; expected one of {', '.join(named)}")
        return named[task]
    if level:
        return Layout(_registered(level), seed)
    if suite not in SUITES:
        raise ValueError(f"unknown suite {suite!r}{suggest(suite, SUITES)}; expected one of {', '.join(SUITES)}")
    if suite == "paper":
        return PAPER[seed % len(PAPER)]
    ids = SUITES[suite]
    return Layout(ids[seed % len(ids)], seed)  # no (id, seed) of `practice` is one of the ten: a test


def _registered(level: str) -> str:
    """`level`, which must be one that MiniGrid registers."""
    import gymnasium
    import minigrid  # noqa: F401  (registers its environments)

    known = [name for name in gymnasium.registry if name.startswith(("MiniGrid-", "BabyAI-"))]
    if level not in known:
        raise ValueError(f"unknown level {level!r}{suggest(level, known)}; expected a registered MiniGrid or BabyAI id")
    return level
