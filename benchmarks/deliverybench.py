"""Speed and size of the DeliveryBench environment on one core.

    python -m benchmarks.deliverybench [--json] [--map DIR] [--shifts 8] [--repeats 3]

The rule-based courier first plays some one-hour shifts (fair rules); its actions are then played again and only the
environment is timed, in CPU seconds of this process. ``steps_per_s`` is the world alone (text of an action in, outcome
out), ``steps_per_s_full_text`` the Gymnasium environment that writes the whole observation after every step,
``steps_per_s_menu`` the menu with the compact text. These are of a running worker, where the ways of earlier episodes
are known; ``steps_per_s_first_play`` and ``steps_per_s_full_text_first_play`` are of the first pass after loading the
city, in which every way is searched, and ``steps_per_s_with_courier`` includes the courier's own planning.

The city is medium-city-22 of the reference maps if these lie beside the repository (``../shared``), else a generated
medium city. Times of the original are the published ones of its logic driven headless on the same kind of core; they
are not measured here.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import statistics
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from agentspec.envs.deliverybench.city.cache import CACHE_VARIABLE
from agentspec.envs.deliverybench.city.citymap import City, forget_cities, load_city
from agentspec.envs.deliverybench.city.generate import write_city
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier
from agentspec.envs.deliverybench.view.cards import OfferCards, describe
from agentspec.envs.deliverybench.view.full import around, full_text
from agentspec.envs.deliverybench.world.engine import World

REFERENCE_MAPS = Path(__file__).resolve().parents[1] / ".." / "shared" / "deliverybench" / "maps"
CITY = "medium-city-22"
GENERATED_SEED = 0
STEPS = 4000
"""Steps for the figures of many environments in one process."""
ORIGINAL_ACTIONS_PER_S = (21.0, 33.0)
ORIGINAL_TEXT_S = (0.3, 0.9)
ENVIRONMENTS = 64
GOALS = {"steps_per_s": 10_000, "steps_per_s_full_text": 2_000, "steps_per_s_menu": 5_000}
LIMITS_MS = {"warm_reset_ms": 2.0, "snapshot_ms": 1.0, "restore_ms": 1.0}

MENU = {"observation": "compact", "action_mode": "menu"}
Shifts = Sequence[Sequence[str]]


def city_folder(chosen: str | None, scratch: Path) -> tuple[Path, str]:
    """The map folder to use, and what it is."""
    if chosen is not None:
        return Path(chosen), f"map {Path(chosen).name}"
    reference = (REFERENCE_MAPS / CITY).resolve()
    if reference.is_dir():
        return reference, f"{CITY} (reference map)"
    made = write_city(scratch / f"medium-{GENERATED_SEED}", "medium", GENERATED_SEED)
    return made, f"{made.name} (generated; the reference maps are not beside the repository)"


def record(folder: Path, options: dict[str, Any], shifts: int) -> tuple[list[list[str]], float]:
    """The rule-based courier's actions in shifts of seeds 0, 1, ..., and steps per second with its planning."""
    env = DeliveryBenchEnv(map=folder, **options)
    played, start = [], time.process_time()
    for seed in range(shifts):
        courier, actions, ended = RuleBasedCourier(env.city), [], False
        _, info = env.reset(seed=seed)
        while not ended:
            actions.append(courier.act(info))
            _, _, terminated, truncated, info = env.step(actions[-1])
            ended = terminated or truncated
        played.append(actions)
    return played, sum(map(len, played)) / (time.process_time() - start)


def world_pass(city: City, shifts: Shifts) -> float:
    """CPU seconds to play the shifts in worlds without any text."""
    seconds = 0.0
    for seed, actions in enumerate(shifts):
        step = World(city, "fair", seed).step
        start = time.process_time()
        for action in actions:
            step(action)
        seconds += time.process_time() - start
    return seconds


def env_pass(env: DeliveryBenchEnv, shifts: Shifts) -> float:
    """CPU seconds to play the shifts in the environment."""
    seconds = 0.0
    for seed, actions in enumerate(shifts):
        env.reset(seed=seed)
        start = time.process_time()
        for action in actions:
            env.step(action)
        seconds += time.process_time() - start
    return seconds


def rates(play: Callable[[], float], shifts: Shifts, repeats: int) -> tuple[float, float]:
    """Steps per second of the first pass, and the median of the passes after it."""
    steps = sum(map(len, shifts))
    first, *later = [steps / play() for _ in range(repeats + 1)]
    return first, statistics.median(later)


def milliseconds(call: Callable[[], Any], count: int) -> float:
    """Median CPU milliseconds of a call."""
    times = []
    for _ in range(count):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1000.0 * statistics.median(times)


def starts(folder: Path) -> dict[str, float]:
    """Wall milliseconds to the first observation: map never seen, map in the disk cache, and environment running."""

    def first_observation() -> float:
        forget_cities()
        start = time.perf_counter()
        DeliveryBenchEnv(map=folder).reset(seed=0)
        return 1000.0 * (time.perf_counter() - start)

    cold, cached = first_observation(), statistics.median(first_observation() for _ in range(5))
    env, seeds = DeliveryBenchEnv(map=folder), iter(range(10**6))
    env.reset(seed=0)
    warm = milliseconds(lambda: env.reset(seed=next(seeds)), 200)
    return {"cold_start_ms": cold, "disk_cache_start_ms": cached, "warm_reset_ms": warm}


def snapshots(folder: Path, actions: Sequence[str]) -> dict[str, float]:
    """Snapshot and restore throughout a shift: milliseconds (median of all places) and bytes (largest)."""
    env = DeliveryBenchEnv(map=folder)
    env.reset(seed=0)
    take, back, size = [], [], 0
    for action in actions:
        env.step(action)
        blob = env.snapshot()
        size = max(size, len(blob))
        take.append(milliseconds(env.snapshot, 3))
        back.append(milliseconds(lambda blob=blob: env.restore(blob), 3))  # type: ignore[misc]
    return {
        "snapshot_ms": statistics.median(take),
        "snapshot_ms_max": max(take),
        "restore_ms": statistics.median(back),
        "restore_ms_max": max(back),
        "snapshot_bytes": size,
    }


def memory(folder: Path, shifts: Shifts) -> float:
    """Bytes of one environment in the middle of a shift, the shared city left out: the mean of `ENVIRONMENTS`."""
    city_env = DeliveryBenchEnv(map=folder)
    env_pass(city_env, shifts)
    gc.collect()
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    envs = []
    for i in range(ENVIRONMENTS):
        env = DeliveryBenchEnv(map=folder)
        env.reset(seed=i % len(shifts))
        for action in shifts[i % len(shifts)][: len(shifts[i % len(shifts)]) // 2]:
            env.step(action)
        envs.append(env)
    gc.collect()
    used = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return used / len(envs)


def many(folder: Path, shifts: Shifts, count: int) -> float:
    """Steps per second with full text of ``count`` environments stepped in turn in this process."""
    envs = [DeliveryBenchEnv(map=folder) for _ in range(count)]
    for i, env in enumerate(envs):
        env.reset(seed=i % len(shifts))
    done, start = 0, time.process_time()
    position = [0] * count
    while done < STEPS:
        for i, env in enumerate(envs):
            actions = shifts[i % len(shifts)]
            if position[i] == len(actions):
                env.reset(seed=i % len(shifts))
                position[i] = 0
            env.step(actions[position[i]])
            position[i] += 1
            done += 1
    return done / (time.process_time() - start)


def text_ms(folder: Path, actions: Sequence[str]) -> float:
    """Milliseconds to write the full observation text, the mean over a first shift in a city just loaded."""
    forget_cities()
    world = World(load_city(folder), "fair", 0)
    cards = OfferCards(world.book)
    seconds = 0.0
    for action in actions:
        world.step(action)
        start = time.process_time()
        view = describe(world, cards)
        full_text(view, around(world.city, world.state.position, view))
        seconds += time.process_time() - start
    return 1000.0 * seconds / len(actions)


def processor() -> str:
    """The processor's name where the system tells it, else its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def measure(folder: Path, shifts: int, repeats: int) -> dict[str, Any]:
    """All figures for one city."""
    result: dict[str, Any] = starts(folder)
    native, result["steps_per_s_with_courier"] = record(folder, {}, shifts)
    menu, _ = record(folder, MENU, shifts)
    result["text_ms"] = text_ms(folder, native[0])
    forget_cities()
    city = load_city(folder)
    first, warm = rates(lambda: world_pass(city, native), native, repeats)
    result |= {"steps_per_s": warm, "steps_per_s_first_play": first}
    for name, options, played in (("full_text", {}, native), ("menu", MENU, menu)):
        forget_cities()
        env = DeliveryBenchEnv(map=folder, **options)  # type: ignore[arg-type]
        first, warm = rates(lambda env=env, played=played: env_pass(env, played), played, repeats)  # type: ignore[misc]
        result |= {f"steps_per_s_{name}": warm, f"steps_per_s_{name}_first_play": first}
    result |= snapshots(folder, native[0])
    result["env_bytes"] = memory(folder, native)
    result["envs_in_one_process"] = {str(n): many(folder, native, n) for n in (1, 16, 64)}
    result["steps_per_shift"] = statistics.mean(map(len, native))
    low, high = (result["steps_per_s"] / rate for rate in reversed(ORIGINAL_ACTIONS_PER_S))
    result["times_original_actions"] = [low, high]
    result["times_original_text"] = [1000.0 * seconds / result["text_ms"] for seconds in ORIGINAL_TEXT_S]
    return result


def table(result: dict[str, Any]) -> str:
    """The figures for people, with goals."""
    lines = [f"DeliveryBench environment, {result['city']}, one core of {result['machine']}", ""]
    for name, goal in GOALS.items():
        first = result[f"{name}_first_play"]
        lines.append(f"{name:28s} {result[name]:10.0f}   first play {first:8.0f}   goal >= {goal}")
    lines.append(f"{'steps_per_s_with_courier':28s} {result['steps_per_s_with_courier']:10.0f}")
    for name, limit in LIMITS_MS.items():
        lines.append(f"{name:28s} {result[name]:10.3f}   goal <= {limit:g}")
    lines += [f"{name:28s} {result[name]:10.1f}" for name in ("cold_start_ms", "disk_cache_start_ms")]
    lines += [f"{name:28s} {result[name]:10.0f}" for name in ("env_bytes", "snapshot_bytes", "steps_per_shift")]
    shares = ", ".join(f"{n}: {rate:.0f}" for n, rate in result["envs_in_one_process"].items())
    lines.append(f"environments in one process, steps/s with full text: {shares}")
    (low, high), (text_low, text_high) = result["times_original_actions"], result["times_original_text"]
    slow, fast = ORIGINAL_ACTIONS_PER_S
    lines += [
        "",
        "Beside the published speed of the original (its logic headless on the same kind of core; not measured here):",
        f"  actions: {low:.0f} to {high:.0f} times its {slow:.0f}-{fast:.0f}/s",
        f"  one full text in {result['text_ms']:.3f} ms: {text_low:.0f} to {text_high:.0f} times faster than its "
        f"{ORIGINAL_TEXT_S[0]:g}-{ORIGINAL_TEXT_S[1]:g} s",
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and print a table, or JSON."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description="Speed and size of the DeliveryBench environment on one core."
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--map", help="map folder (default: see the module's description)")
    parser.add_argument("--shifts", type=int, default=8, help="recorded one-hour shifts")
    parser.add_argument("--repeats", type=int, default=3, help="passes after the first one")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as scratch:
        kept = os.environ.get(CACHE_VARIABLE)
        os.environ[CACHE_VARIABLE] = scratch  # an empty cache, so that the cold start is one
        try:
            folder, name = city_folder(options.map, Path(scratch))
            result = {"city": name, "machine": processor()}
            result |= measure(folder, options.shifts, options.repeats)
        finally:
            if kept is None:
                del os.environ[CACHE_VARIABLE]
            else:
                os.environ[CACHE_VARIABLE] = kept
    print(json.dumps(result, indent=1) if options.json else table(result))


if __name__ == "__main__":
    main()
