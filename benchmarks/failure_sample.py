"""Plays the sample of episodes on which the failure detectors are judged, and writes it for readers to label.

    python -m benchmarks.failure_sample --to DIR --readers TEXTS [--store RESULTS --models 16]

Scripted players (`failure_players`) in four worlds, and finished episodes of language models out of an evaluation's
folder. DIR gets `episodes.jsonl.gz` (the trajectories, without model calls) and `sources.json` (who played what). TEXTS
gets what readers get, and nothing else: one numbered text per episode in an order drawn by chance, and what to do.
"""

from __future__ import annotations

import argparse
import gzip
import json
import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from agentspec.files import write_atomic
from agentspec.trajectory import Trajectory, read_trajectories
from agentspec.types import Task
from benchmarks import failure_players as p
from eval.failures import played
from eval.labels import Sample
from eval.transcripts import SURROUNDINGS, transcript

COURIER = {"size": "tiny", "shift_hours": 0.5, "max_steps": 18}
MENU = {"size": "tiny", "shift_hours": 0.3, "max_steps": 14, "observation": "compact", "action_mode": "menu"}
ROOM, HOME = {"max_steps": 24}, {"max_steps": 24}
OWN = ("Your task", "Find an object")
ROOM_MENU = {"max_steps": 20, "action_mode": "menu"}


def grid(level: str) -> dict[str, Any]:
    """A grid of 28 steps."""
    return {"level": level, "max_steps": 28, "observation": "basic"}


def world(name: str) -> list[tuple[str, dict[str, Any], int, p.Act, str]]:
    """(player, options, seed, act, whose advice) of a world's scripted episodes."""
    return {"deliverybench": couriers, "minigrid": grids, "alfred": rooms, "robothor": homes}[name]()


def couriers() -> list[tuple[str, dict[str, Any], int, p.Act, str]]:
    """DeliveryBench, by native calls and by menu."""
    wrong = ('DROP_OFF(oid=0, method="leave_at_door")', "CHARGE(target_pct=80)", "REST(target_pct=100)", "RENT_CAR()")
    values = ('MOVE(x="far", y="away")', "ACCEPT_ORDER('six')", "WAIT('soon')", "PICKUP(orders=[77])", "MOVE(-24.2m)")
    invented = ("TAKE_TAXI()", "CALL_CUSTOMER(3)", "I will go to restaurant 1 now.", "SLEEP(60)", "LOOK_AROUND()")
    prose = ("I accept the best order.", "accept order 99", "GO HOME", "Let me think about the next step.")
    charge = 'CHARGE(target_pct="full")'
    return [
        ("honest", COURIER, 1, p.honest, "rule_based"),
        ("random", COURIER, 2, p.honest, "random"),
        ("reads the board again", COURIER, 3, p.sometimes(0.4, "VIEW_ORDERS()"), "rule_based"),
        ("wrong values", COURIER, 4, p.sometimes(0.35, *values), "rule_based"),
        ("inventor", COURIER, 5, p.sometimes(0.3, *invented), "rule_based"),
        ("fetches from afar", COURIER, 6, p.sometimes(0.4, p.fetches_from_afar), "rule_based"),
        ("forgets", COURIER, 7, p.at_steps(dict.fromkeys((2, 13, 16), wrong[1])), "rule_based"),
        ("dawdles", COURIER, 8, p.dawdles, "rule_based"),
        ("never charges", {**COURIER, "shift_hours": 1.0}, 9, p.never_charges, "rule_based"),
        ("idle", COURIER, 10, p.always("WAIT(300)"), "rule_based"),
        ("hoards", COURIER, 11, p.hoards, "rule_based"),
        ("copies", COURIER, 12, p.sometimes(0.3, p.copies), "rule_based"),
        ("breaks rules", COURIER, 13, p.sometimes(0.35, *wrong, p.hands_over_anywhere), "rule_based"),
        ("says it again", COURIER, 15, p.at_steps({4: charge, 5: p.again, 6: p.again}), "rule_based"),
        ("honest, menu", MENU, 16, p.honest, "rule_based"),
        ("random, menu", MENU, 17, p.honest, "random"),
        ("waits, menu", MENU, 18, p.prefers("wait"), "rule_based"),
        ("more choices, menu", MENU, 19, p.prefers("more choices", "fewer", "back"), "rule_based"),
        ("accepts, menu", MENU, 20, p.prefers("accept"), "rule_based"),
        ("prose, menu", MENU, 21, p.sometimes(0.4, *prose), "rule_based"),
    ]


def grids() -> list[tuple[str, dict[str, Any], int, p.Act, str]]:
    """MiniGrid."""
    two = ("TURN_LEFT()", "TURN_LEFT()")
    invented = ("MOVE_UP()", "GO_TO(goal)", "I turn to the left.", "JUMP()")
    return [
        ("honest", grid("MiniGrid-GoToDoor-5x5-v0"), 1, p.honest, "rule_based"),
        ("careless", grid("MiniGrid-SimpleCrossingS9N1-v0"), 2, p.sometimes(0.3, "TURN_LEFT()"), "rule_based"),
        ("random", grid("MiniGrid-FourRooms-v0"), 3, p.honest, "random"),
        ("straight on", grid("MiniGrid-Empty-16x16-v0"), 4, p.always("FORWARD()"), "rule_based"),
        ("turns", grid("MiniGrid-Empty-6x6-v0"), 5, p.always("TURN_LEFT()"), "rule_based"),
        ("to and fro", grid("MiniGrid-MultiRoom-N2-S4-v0"), 6, p.always("FORWARD()", *two), "rule_based"),
        ("picks nothing", grid("MiniGrid-Fetch-5x5-N2-v0"), 7, p.sometimes(0.4, "PICK_UP()", "TOGGLE()"), "rule_based"),
        ("grabs", grid("MiniGrid-Fetch-8x8-N3-v0"), 9, p.grabs, "rule_based"),
        ("done early", grid("MiniGrid-GoToObject-6x6-N2-v0"), 10, p.at_steps({2: "DONE()"}), "rule_based"),
        ("into lava", grid("MiniGrid-LavaGapS5-v0"), 11, p.into_lava, "rule_based"),
        ("inventor", grid("MiniGrid-GoToObject-6x6-N2-v0"), 12, p.sometimes(0.4, *invented), "rule_based"),
        ("no key", grid("MiniGrid-DoorKey-5x5-v0"), 13, p.sometimes(0.5, "TOGGLE()", "FORWARD()"), "rule_based"),
        ("copies", grid("MiniGrid-LavaCrossingS9N1-v0"), 14, p.sometimes(0.3, p.copies), "rule_based"),
    ]  # fmt: skip


def rooms() -> list[tuple[str, dict[str, Any], int, p.Act, str]]:
    """ALFRED, by native calls and by menu."""
    absent = ('PICKUP("unicorn 1")', 'OPEN("fridge 7")', 'PICKUP("statue 2")', 'TOGGLE_ON("radio 1")')
    values = ("PICKUP()", 'PUT("mug 1")', "OPEN(3)", "MOVE_AHEAD(5)", "SLICE()")
    order = ('PUT("apple 1", "fridge 1")', 'OPEN("counter top 1")', 'SLICE("bread 1")', 'CLOSE("cabinet 1")')
    return [
        ("honest", ROOM, 1, p.honest, "rule_based"),
        ("honest, menu", ROOM_MENU, 2, p.honest, "rule_based"),
        ("random", ROOM, 3, p.honest, "random"),
        ("straight on", ROOM, 4, p.always("MOVE_AHEAD()"), "rule_based"),
        ("what is not there", ROOM, 5, p.sometimes(0.35, *absent), "rule_based"),
        ("wrong values", ROOM, 6, p.sometimes(0.35, *values), "rule_based"),
        ("wrong order", ROOM, 7, p.sometimes(0.4, *order), "rule_based"),
        ("takes anything, menu", ROOM_MENU, 8, p.takes_anything, "rule_based"),
        ("forgets", ROOM, 0, p.at_steps(dict.fromkeys((1, 13, 22), 'OPEN("safe 1")')), "rule_based"),
        ("says it again", ROOM, 1, p.sometimes(0.5, p.again), "rule_based"),
    ]  # fmt: skip


def homes() -> list[tuple[str, dict[str, Any], int, p.Act, str]]:
    """RoboTHOR."""
    invented = ("SEARCH()", "GO_TO(kitchen)", "I look for the target.", "PICKUP(apple)")
    return [
        ("honest", HOME, 1, p.honest, "rule_based"),
        ("careless", HOME, 2, p.sometimes(0.3, "ROTATE_LEFT()"), "rule_based"),
        ("random", HOME, 3, p.honest, "random"),
        ("stops at once", HOME, 4, p.first_then(("MOVE_AHEAD()",), p.always("STOP()")), "rule_based"),
        ("turns", HOME, 5, p.always("ROTATE_RIGHT()"), "rule_based"),
        ("straight on", HOME, 6, p.always("MOVE_AHEAD()"), "rule_based"),
        ("stops in sight of anything", HOME, 7, p.stops_in_sight, "rule_based"),
        ("inventor", HOME, 8, p.sometimes(0.35, *invented), "rule_based"),
    ]


def scripted(later: int = 0) -> Iterator[tuple[str, Trajectory]]:
    """Who played, and the episode; `later` is added to all seeds."""
    for name in ("deliverybench", "minigrid", "alfred", "robothor"):
        for who, options, seed, act, role in world(name):
            task = Task(name, seed + later, options, "test")
            at = p.seat(task, seed + later, role)
            yield f"scripted: {who}", played(task, lambda text, info, at=at, act=act: _next(at, act, text, info))


def _next(at: p.Seat, act: p.Act, text: str, info: Any) -> str:
    at.text, at.info = text, info
    at.said.append(said := act(at))
    return said


def of_models(store: Path, most: int, seed: int, taken: set[tuple[str, ...]]) -> Iterator[tuple[str, Trajectory]]:
    """Episodes of models from an evaluation's folder: as even over (policy, scaffold, world) as there are, no two with
    the same actions, none of `taken`."""
    pools: dict[tuple[str, str, str], list[Trajectory]] = {}
    for path in sorted(store.glob("trajectories/*/*/*.jsonl")):
        for t in read_trajectories(path):
            if t.scorable and t.calls:
                pools.setdefault((t.policy, path.parent.name, t.task.env), []).append(t)
    rng = random.Random(seed)
    for pool in pools.values():
        rng.shuffle(pool)
    names = list(pools)
    rng.shuffle(names)
    while most and any(pools.values()):
        for name in names:
            fresh = [t for t in pools[name] if _actions(t) not in taken]
            pools[name] = fresh
            if fresh and most:
                t = fresh.pop()
                taken.add(_actions(t))
                most -= 1
                yield f"model: {name[0]}, {name[1]}", t


def _actions(t: Trajectory) -> tuple[str, ...]:
    return (t.task.env, *(step.action_text for step in t.transitions))


def bare(t: Trajectory) -> Trajectory:
    """The episode without what no rule reads: model calls, turns, traces, the agent."""
    steps = [
        replace(s, decision=replace(s.decision, turn=(), trace={}, calls=(), candidates=(), rationale=""))
        for s in t.transitions
    ]
    return replace(t, spec={}, calls=(), transitions=tuple(steps))


def main() -> None:
    """Play, shuffle, write."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--to", required=True, type=Path, help="folder to write into")
    parser.add_argument("--readers", required=True, type=Path, help="folder for what readers get")
    parser.add_argument("--store", type=Path, help="an evaluation with trajectories of models")
    parser.add_argument("--models", type=int, default=16, help="most episodes out of it (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=15, help="of the order and the choice (default: %(default)s)")
    parser.add_argument("--scripted", type=int, help="most scripted episodes (default: all)")
    parser.add_argument("--without", type=Path, help="a sample none of whose episodes is taken again")
    parser.add_argument("--later", type=int, default=0, help="added to the seeds of scripted episodes: another sample")
    options = parser.parse_args()
    taken = {_actions(t) for t in Sample.episodes_of(options.without).values()} if options.without else set()
    found = [(who, t) for who, t in scripted(options.later) if _actions(t) not in taken]
    random.Random(options.seed).shuffle(found)
    found = found[: options.scripted]
    if options.store:
        found += of_models(options.store, options.models, options.seed, taken)
    random.Random(options.seed).shuffle(found)
    packed = gzip.compress("".join(bare(t).to_json() + "\n" for _, t in found).encode(), 9, mtime=0)
    options.to.mkdir(parents=True, exist_ok=True)
    (options.to / "episodes.jsonl.gz").write_bytes(packed)
    sources = {f"{i:03}": who for i, (who, _) in enumerate(found, 1)}
    write_atomic(options.to / "sources.json", json.dumps(sources, indent=1) + "\n")
    write_texts([t for _, t in found], options.readers)
    print(f"{len(found)} episodes, {len(packed) / 1e3:.0f} kB")


def write_texts(episodes: Sequence[Trajectory], folder: Path) -> None:
    """What readers get: the instructions, the rules of each world once, and the episodes."""
    for name in ("transcripts", "worlds"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    rules: dict[str, str] = {}
    for t in episodes:
        told = t.transitions[0].input.instruction
        rules[t.task.env] = max(rules.get(t.task.env, ""), told, key=len)
    known = {env: [line for line in text.splitlines() if not line.startswith(OWN)] for env, text in rules.items()}
    for env, lines in known.items():
        write_atomic(folder / "worlds" / f"{env}.txt", "\n".join(lines) + "\n")
    for i, t in enumerate(episodes, 1):
        text = transcript(t, known=known[t.task.env], left_out=SURROUNDINGS)
        write_atomic(folder / "transcripts" / f"{i:03}.txt", f"EPISODE: {i:03}\n{text}\n")
    write_atomic(folder / "LABELS.md", (files("eval") / "data/failures/LABELS.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
