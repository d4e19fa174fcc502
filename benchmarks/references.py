"""Upper and lower reference of every world: the expert that the environment names, and random actions.

    python -m benchmarks.references [--json] [--world NAME] [--draws 3] [--household DIR]

Means over the episodes of a suite; the random player plays each `--draws` times. The expert knows everything, so it
bounds what can be had; a policy that is no better than the random player has learned nothing. The public scenes are
used if they lie beside the repository (`../shared/household`).
"""

from __future__ import annotations

import argparse
import json
import random
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from agentspec.envs import experts
from agentspec.envs.making import make_env
from agentspec.types import Task

HOUSEHOLD = Path(__file__).resolve().parents[2] / "shared" / "household"
FIGURES = {
    "alfred": ("success", "goal_conditions", "spl", "primitive_steps"),
    "robothor": ("success", "spl", "path_length", "distance_left"),
    "minigrid": ("success", "efficiency"),
}
"""World -> what is told of it, besides the return and the number of actions."""

Rows = list[tuple[dict[str, Any], int]]


def suites(household: Path) -> Iterator[tuple[str, str, Rows]]:
    """World, title, and (options, seed) of the episodes."""
    trials, objects = str(household / "alfred_json_2.1.0"), str(household / "objects")
    for mode in ("native", "menu"):
        yield "alfred", f"own, {mode}", [({"action_mode": mode}, seed) for seed in range(16)]
        if household.is_dir():
            paper = {"suite": "paper", "data": trials, "action_mode": mode}
            yield "alfred", f"paper, {mode}", [({**paper, "trial": t}, seed) for t in range(3) for seed in range(7)]
    for preset in ("paper", "challenge2021", "casestudy"):
        yield "robothor", f"own, {preset}", [({"preset": preset}, seed) for seed in range(10)]
    if household.is_dir():
        validation = {"suite": "validation", "data": str(household / "robothor" / "val"), "objects": objects}
        yield "robothor", "validation, paper", [(validation, seed) for seed in range(10)]
    for suite, count in (("paper", 10), ("memory", 30), ("babyai", 30)):
        yield "minigrid", f"{suite}, menu", [({"suite": suite, "action_mode": "menu"}, s) for s in range(count)]


def play(world: str, options: Mapping[str, Any], seed: int, role: str, draw: int) -> dict[str, float]:
    """One episode: its figures, return and number of actions."""
    env = make_env(Task(world, seed, dict(options))).unwrapped
    player = experts.player(world, role, options, random.Random(1000 * seed + draw))
    _, info = env.reset(seed=seed)
    total, actions, ended = 0.0, 0, False
    while not ended:
        _, reward, terminated, truncated, info = env.step(player.act(info))
        total, actions, ended = total + reward, actions + 1, terminated or truncated
    env.close()
    told = {name: info["metrics"][name] for name in FIGURES[world]}
    return {**{k: float(v) for k, v in told.items() if v is not None}, "return": total, "actions": float(actions)}


def means(episodes: list[dict[str, float]]) -> dict[str, float]:
    """Means of the figures that all or some episodes have."""
    names = dict.fromkeys(name for episode in episodes for name in episode)
    found = {}
    for name in names:
        values = [e[name] for e in episodes if name in e]
        found[name] = sum(values) / len(values)
    return found


def main() -> None:
    """Play and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--world", choices=tuple(FIGURES), default=None)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--household", type=Path, default=HOUSEHOLD)
    given = parser.parse_args()
    result: list[dict[str, Any]] = []
    for world, title, rows in suites(given.household):
        if given.world not in (None, world):
            continue
        for role, draws in (("rule_based", 1), ("random", given.draws)):
            played = [play(world, options, seed, role, d) for options, seed in rows for d in range(draws)]
            result.append({"world": world, "suite": title, "player": role, "episodes": len(played), **means(played)})
            if not given.json:
                told = ", ".join(f"{k} {v:.3g}" for k, v in means(played).items())
                print(f"{world} | {title} | {role} | {len(played)} episodes | {told}", flush=True)
    if given.json:
        print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
