"""Speed of every world on one core: steps with text, with pictures, without either, resets and snapshots.

    python -m benchmarks.worlds [--json] [--steps 600] [--repeats 3] [--household DIR]

Random players first play some episodes; their actions are then played again and only the environment is timed, in CPU
seconds of this process (medians of passes that take turns). Beside each environment stands the world under it: for
MiniGrid the bare environment's own step, for ALFRED and RoboTHOR the offline player, for DeliveryBench the engine; the
ratio is the world's rate over the environment's, so 1.3 means a third more time. Where ai2thor is installed, the same
primitives also go through its Controller with the stand-in (2.1.0: ALFRED over HTTP, 5.0.0: RoboTHOR over pipes);
that involves two processes, so it is timed in wall seconds, as is the offline player beside it.

The public scenes are used if they lie beside the repository (`../shared/household`), else the package's own.
"""

from __future__ import annotations

import argparse
import json
import platform
import random
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium

from agentspec.envs import experts
from agentspec.envs.alfred.env import AlfredEnv
from agentspec.envs.alfred.staging import set_up
from agentspec.envs.deliverybench.world.engine import World
from agentspec.envs.making import make_env
from agentspec.envs.thor.engine import OfflineThor
from agentspec.envs.thor.simulator.player import Ai2Thor
from agentspec.types import Task

HOUSEHOLD = Path(__file__).resolve().parents[2] / "shared" / "household"
GOALS = {"minigrid": ("ratio", 1.3), "alfred": ("text", 2000.0), "robothor": ("text", 2000.0)}
PICTURES = 60.0
"""Steps per second with 300 px that ALFRED and RoboTHOR are to reach."""

VERSIONS = {"alfred": "2.1.0", "robothor": "5.0.0"}
Play = tuple[int, list[str], list[Any]]
"""Of an episode: its seed, the texts, and what the world under the environment got for them."""


def worlds(household: Path) -> dict[str, dict[str, Any]]:
    """World -> options."""
    found: dict[str, dict[str, Any]] = {"minigrid": {"observation": "compact"}, "alfred": {}, "robothor": {}}
    if household.is_dir():
        found["alfred"] = {"suite": "paper", "data": str(household / "alfred_json_2.1.0")}
        found["robothor"] = {"suite": "validation", "data": str(household / "robothor" / "val")}
        found["robothor"]["objects"] = str(household / "objects")
    return found | {"deliverybench": {}}


def record(name: str, options: Mapping[str, Any], steps: int) -> list[Play]:
    """Episodes of the random player, some `steps` in all."""
    env = make_env(Task(name, 0, dict(options))).unwrapped
    plays: list[Play] = []
    while sum(len(texts) for _, texts, _ in plays) < steps:
        seed = len(plays)
        player = experts.player(name, "random", options, random.Random(seed))
        _, info = env.reset(seed=seed)
        texts: list[str] = []
        under: list[Any] = []
        if name in VERSIONS:
            _overhear(env, under)
        ended = False
        while not ended and len(texts) < steps:
            texts.append(player.act(info))
            _, _, terminated, truncated, info = env.step(texts[-1])
            ended = terminated or truncated
        if name == "minigrid":
            under = [a for a in env._history if a >= 0]
        plays.append((seed, texts, under or list(texts)))
    env.close()
    return plays


def _overhear(env: Any, heard: list[Any]) -> None:
    """Note the primitives that the environment gives its player in this episode."""
    step = env.world.step

    def noted(action: Mapping[str, Any]) -> Any:
        heard.append(dict(action))
        return step(action)

    env.world.step = noted


# -- what is timed -----------------------------------------------------------------------------------------------------


def seconds(step: Callable[[Any], Any], actions: Sequence[Any], clock: Callable[[], float]) -> float:
    """Seconds of the actions one after the other."""
    start = clock()
    for action in actions:
        step(action)
    return clock() - start


def env_pass(env: Any, plays: Sequence[Play], clock: Callable[[], float] = time.process_time) -> float:
    """Steps per second of an environment."""
    spent = 0.0
    for seed, texts, _ in plays:
        env.reset(seed=seed)
        spent += seconds(env.step, texts, clock)
    return sum(len(texts) for _, texts, _ in plays) / spent


def world_pass(name: str, env: Any, plays: Sequence[Play]) -> float:
    """Steps per second of what is under an environment."""
    spent, count = 0.0, 0
    for seed, _, under in plays:
        env.reset(seed=seed)
        step: Callable[[Any], Any]
        if name == "minigrid":
            bare = gymnasium.make(env.layout.id, max_steps=env.max_steps, disable_env_checker=True).unwrapped
            bare.reset(seed=env.layout.seed)
            step = bare.step
        elif name == "deliverybench":
            step = World(env.city, "fair", seed).step
        else:
            step = env.world.step
        spent += seconds(step, under, time.process_time)
        count += len(under)
    return count / spent


def milliseconds(call: Callable[[], Any], count: int) -> float:
    """Median CPU milliseconds of a call."""
    times = []
    for _ in range(count):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1000.0 * statistics.median(times)


def measure(name: str, options: Mapping[str, Any], steps: int, repeats: int) -> dict[str, Any]:
    """All figures of a world."""
    plays = record(name, options, steps)
    env = make_env(Task(name, 0, dict(options))).unwrapped
    env_pass(env, plays[:1])
    passes = [(world_pass(name, env, plays), env_pass(env, plays)) for _ in range(repeats)]
    under, text = (statistics.median(p[i] for p in passes) for i in (0, 1))
    few = [(seed, texts[:60], under[:60]) for seed, texts, under in plays[:2]]
    pictured = make_env(Task(name, 0, {**options, "images": True})).unwrapped
    image = statistics.median(env_pass(pictured, few) for _ in range(repeats))
    env.reset(seed=plays[0][0])
    seconds(env.step, plays[0][1][:30], time.process_time)
    blob, seeds = env.snapshot(), iter(range(10**6))
    row: dict[str, Any] = {
        "options": {k: v for k, v in options.items() if k not in ("data", "objects")},
        "steps": sum(len(texts) for _, texts, _ in plays),
        "world": under,
        "text": text,
        "ratio": under / text,
        "image": image,
        "snapshot_ms": milliseconds(env.snapshot, 20),
        "restore_ms": milliseconds(lambda: env.restore(blob), 20),
        "reset_ms": milliseconds(lambda: env.reset(seed=next(seeds) % 7), 21),
    }
    env.close()
    pictured.close()
    return row


def controller(name: str, options: Mapping[str, Any], plays: Sequence[Play]) -> dict[str, float] | None:
    """Wall steps per second through ai2thor's Controller and offline, alternating; None where it is not installed."""
    try:
        if version("ai2thor") != VERSIONS[name]:
            return None
    except (KeyError, PackageNotFoundError):
        return None
    env = make_env(Task(name, 0, dict(options))).unwrapped
    env.reset(seed=0)
    remote = Ai2Thor(
        VERSIONS[name], env.settings, executable="standin", pictures=False, folders=env._simulated["folders"]
    )
    spent = {"controller": 0.0, "offline": 0.0}
    for seed, _, under in plays:
        env.reset(seed=seed)
        remote.begin(env.world.scene.name)
        if isinstance(env, AlfredEnv):
            set_up(remote, env.trial)
        spent["controller"] += seconds(remote.step, under, time.perf_counter)
        local: OfflineThor = env.world
        spent["offline"] += seconds(local.step, under, time.perf_counter)
    remote.close()
    count = sum(len(under) for *_, under in plays)
    rates = {key: count / value for key, value in spent.items()}
    return rates | {"ratio": rates["offline"] / rates["controller"]}


def report(result: Mapping[str, Any]) -> str:
    """A table."""
    lines = ["| world | bare, steps/s | with text | ratio | with pictures | reset ms | snapshot ms | restore ms |"]
    lines.append("|---|---:|---:|---:|---:|---:|---:|---:|")
    for name, r in result["worlds"].items():
        lines.append(
            f"| {name} | {r['world']:,.0f} | {r['text']:,.0f} | {r['ratio']:.2f} | {r['image']:,.0f} | "
            f"{r['reset_ms']:.2f} | {r['snapshot_ms']:.3f} | {r['restore_ms']:.2f} |"
        )
    for name, r in result["controllers"].items():
        lines.append(
            f"\n{name} through ai2thor {VERSIONS[name]}'s Controller and the stand-in: {r['controller']:,.0f} steps/s "
            f"of wall time, offline {r['offline']:,.0f} ({r['ratio']:.0f}x)"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--household", type=Path, default=HOUSEHOLD)
    given = parser.parse_args()
    found = worlds(given.household)
    result: dict[str, Any] = {"machine": platform.processor() or platform.machine(), "worlds": {}, "controllers": {}}
    for name, options in found.items():
        result["worlds"][name] = measure(name, options, given.steps, given.repeats)
        through = controller(name, options, record(name, options, given.steps // 4)) if name in VERSIONS else None
        if through is not None:
            result["controllers"][name] = through
    reached = {}
    for name, (figure, goal) in GOALS.items():
        value = result["worlds"][name][figure]
        reached[f"{name} {figure}"] = {"value": value, "goal": goal, "reached": (value <= goal) == (figure == "ratio")}
    for name in VERSIONS:
        value = result["worlds"][name]["image"]
        reached[f"{name} image"] = {"value": value, "goal": PICTURES, "reached": value >= PICTURES}
    result["goals"] = reached
    print(json.dumps(result, indent=2) if given.json else report(result))


if __name__ == "__main__":
    main()
