"""Replay of reference episodes: does this world behave like the original, number for number?

    python -m agentspec.envs.deliverybench.replay --maps DIR --traces FILE_OR_DIR [--json]

A reference episode is a recording of the original logic: a city, a seed, settings, and per action the full state
afterwards. The same actions are given to a `World` under the "original" rules, and after every step success, clock,
position, energy, battery, money, mode, orders, pool, food, bag, inventory, vehicles, bus and settlements are compared.
One line per episode, with its first mismatch; the exit status is 0 only if every episode matches.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from agentspec.envs.deliverybench.city.citymap import load_city
from agentspec.envs.deliverybench.world.bag import Item
from agentspec.envs.deliverybench.world.engine import Outcome, World
from agentspec.envs.deliverybench.world.rules import RULE_SETS
from agentspec.envs.deliverybench.world.settlement import Settlement
from agentspec.envs.deliverybench.world.state import PARKED, State

TIME, PLACE, LEVEL, MONEY, HEAT, FINE = 0.11, 0.02, 0.01, 0.01, 0.05, 1e-3
"""Tolerances: seconds, metres, percent, dollars, deg C, and everything without a physical unit (odour, scores)."""

Pair = tuple[str, Any, Any, float]


def world_for(trace: Mapping[str, Any], maps: Path) -> World:
    """A fresh world with the map, seed and settings of a reference episode."""
    config = trace.get("config", {})
    hours = config.get("lifecycle", {}).get("duration_hours", 2.0)
    rules = RULE_SETS["original"].with_config(config)
    return World(load_city(maps / trace["map"]), rules, trace["seed"], shift_hours=float(hours))


def replay(trace: Mapping[str, Any], maps: Path, every: bool = False) -> list[str]:
    """The mismatches of one episode, as ``"step 12 MOVE(...): energy 3.1, expected 3.2"``.

    The first only, or with ``every`` all of them (later ones may follow from the first).
    """
    world = world_for(trace, maps)
    found: list[str] = []
    for number, step in enumerate([None, *trace["steps"]]):
        if step is None:
            pairs = _state_pairs(world.look(), trace["initial"], world)
            label = "start"
        else:
            outcome = world.step(step["action"])
            pairs = _step_pairs(outcome, step, world)
            label = f"step {number - 1} {step['action'][:60]}"
        wrong = [_tell(pair) for pair in pairs if not agree(pair[1], pair[2], pair[3])]
        if wrong:
            found.append(f"{label}: " + "; ".join(wrong[:4]))
            if not every:
                break
    return found


def agree(got: Any, expected: Any, tolerance: float) -> bool:
    """Equality with a tolerance for numbers, element by element for lists and mappings."""
    if isinstance(expected, bool) or isinstance(got, bool):
        return got is expected
    if isinstance(got, (int, float)) and isinstance(expected, (int, float)):
        return abs(got - expected) <= tolerance
    if isinstance(got, (list, tuple)) and isinstance(expected, (list, tuple)):
        return len(got) == len(expected) and all(agree(a, b, tolerance) for a, b in zip(got, expected, strict=True))
    if isinstance(got, dict) and isinstance(expected, dict):
        return got.keys() == expected.keys() and all(agree(got[key], expected[key], tolerance) for key in got)
    return bool(got == expected)


def _tell(pair: Pair) -> str:
    name, got, expected, _ = pair
    return f"{name} {_short(got)}, expected {_short(expected)}"


def _short(value: Any) -> str:
    shown = repr(round(value, 6)) if isinstance(value, float) else repr(value)
    return shown if len(shown) <= 120 else shown[:117] + "..."


def _step_pairs(outcome: Outcome, step: Mapping[str, Any], world: World) -> Iterator[Pair]:
    state = world.look()
    yield "success", outcome.ok, step["success"], 0.0
    yield "time", state.tick / 10.0, step["t1"], TIME
    yield "ended", outcome.ended, step["ended"], 0.0
    yield "parsed", not outcome.code.startswith(_UNREAD), step["parsed"], 0.0
    yield from _state_pairs(state, step["state"], world)
    yield "settlements", [s.order_id for s in outcome.settlements], [r["id"] for r in step["completed"]], 0.0
    for settlement, record in zip(outcome.settlements, step["completed"], strict=False):
        yield from _settlement_pairs(settlement, record)


_UNREAD = (
    "PARSE_",
    "PU_NO_ORDERS",
    "BAG_EMPTY",
    "DO_NO_METHOD",
    "DO_BAD_METHOD",
    "BUY_EMPTY",
    "BUY_QTY",
    "BUY_BAD_ITEMS",
    "PK_COMP",
    "SW_EMPTY",
    "SAY_EMPTY",
    "HELP_KIND",
)


def _state_pairs(state: State, want: Mapping[str, Any], world: World) -> Iterator[Pair]:
    scooter = state.scooter
    yield "position", _metres(state.position), [want["x"], want["y"]], PLACE
    yield "mode", state.mode, want["mode"], 0.0
    yield "pace", state.pace, want["pace"], 0.0
    yield "energy", state.energy, want["energy"], LEVEL
    yield "battery", scooter.battery, want["battery"], LEVEL
    yield "money", state.balance, want["earnings"], MONEY
    yield "scooter", scooter.state, want["scooter_state"], 0.0
    yield "scooter parked at", _metres(scooter.park), want["scooter_park"], PLACE
    yield "renting", state.car is not None and not state.ended, want["renting"], 0.0
    yield "car", _car(state), want["car"], PLACE
    yield "charging", _charging(state), want["charging"], LEVEL
    yield "in hospital", state.hospital_until is not None, want["in_hospital"], 0.0
    yield "inventory", _present(state.inventory), _present(want["inventory"]), 0.0
    yield "pool", state.pool, want["pool"], 0.0
    yield "carrying", sorted(state.carrying), sorted(want["carrying"]), 0.0
    pending = {str(n): [item.name for item in o.pending] for n, o in state.orders.items() if o.pending}
    yield "in hand", pending, want["pending_food"], 0.0
    yield "orders", list(state.orders), [row["id"] for row in want["active_orders"]], 0.0
    for row in want["active_orders"]:
        yield from _order_pairs(state, row)
    for row in want["bag"]:
        compartment = state.bag.compartments[row["comp"]]
        yield f"air {row['comp']}", compartment.air, row["air_c"], HEAT
        yield f"bag {row['comp']}", [_owner(i) for i in compartment.items], [_owner_row(r) for r in row["items"]], 0.0
        yield from _item_pairs(f"bag {row['comp']}", compartment.items, row["items"])
    yield from _bus_pairs(state, want, world)


def _order_pairs(state: State, row: Mapping[str, Any]) -> Iterator[Pair]:
    order = state.orders.get(row["id"])
    name = f"order {row['id']}"
    if order is None:
        yield name, None, "active", 0.0
        return
    elapsed = (state.tick - order.accepted) / 10.0
    yield f"{name} elapsed", elapsed, row["elapsed_s"], TIME
    yield f"{name} time left", order.offer.limit - elapsed, row["time_left_s"], TIME
    yield f"{name} accepted", order.accepted / 10.0, row["accepted_at"], TIME
    yield f"{name} picked up", order.picked is not None, row["picked_up"], 0.0
    yield f"{name} ready", elapsed >= order.offer.prep, row["ready"], 0.0
    yield f"{name} pick score", order.pick_score, row["pick_score"], FINE
    yield f"{name} items", [food.name for food in order.offer.foods], [r["name"] for r in row["items"]], 0.0
    if order.picked is not None:
        yield from _item_pairs(name, order.items, row["items"])


def _item_pairs(name: str, items: list[Item], rows: list[Mapping[str, Any]]) -> Iterator[Pair]:
    yield f"{name} temperatures", [i.temp for i in items], [r["temp_c"] for r in rows], HEAT
    yield f"{name} odours", [i.odour for i in items], [r["odor"] for r in rows], FINE
    yield f"{name} damage", [i.damage for i in items], [r["damage"] for r in rows], 0.0


def _bus_pairs(state: State, want: Mapping[str, Any], world: World) -> Iterator[Pair]:
    phase = world.timetable.phase(state.tick)
    for row in want.get("buses", ())[:1]:
        if phase is None:
            yield "bus", None, row["state"], 0.0
            continue
        yield "bus", "stopped" if phase.stopped else "moving", row["state"], 0.0
        yield "bus position", _metres(phase.position), [row["x"], row["y"]], PLACE


def _settlement_pairs(settlement: Settlement, record: Mapping[str, Any]) -> Iterator[Pair]:
    name = f"settlement {record['id']}"
    stars, flags = record["stars"], record["flags"]
    checks: tuple[tuple[str, Any, Any, float], ...] = (
        ("paid", settlement.paid, record["paid_total"], MONEY),
        ("bonus", settlement.bonus, record["bonus_extra"], MONEY),
        ("duration", settlement.duration, record["duration_s"], TIME),
        ("stars", settlement.stars, stars["overall"], 0.0),
        ("time star", settlement.time_star, stars["time"], 0.0),
        ("food star", settlement.food_star, stars["food"], 0.0),
        ("method star", settlement.method_star, stars["method"], 0.0),
        ("item stars", settlement.item_stars, record["breakdown"]["food"]["per_item_stars"], 0.0),
        ("on time", settlement.on_time, flags["on_time"], 0.0),
        ("temperature flag", settlement.temp_ok, flags["temp_ok_all"], 0.0),
        ("odour flag", settlement.odour_ok, flags["odor_ok_all"], 0.0),
        ("damage flag", settlement.damage_ok, flags["damage_ok_all"], 0.0),
    )
    for part, got, expected, tolerance in checks:
        yield f"{name} {part}", got, expected, tolerance


def _metres(point: tuple[float, float] | None) -> list[float] | None:
    return None if point is None else [point[0] / 100.0, point[1] / 100.0]


def _car(state: State) -> dict[str, Any] | None:
    car = state.car
    return None if car is None else {"state": car.state, "park": _metres(car.park if car.state == PARKED else None)}


def _charging(state: State) -> dict[str, float] | None:
    session = state.charging
    return None if session is None else {"paid_pct": state.scooter.battery, "target_pct": session.target}


def _present(inventory: Mapping[str, int]) -> dict[str, int]:
    return {item: count for item, count in inventory.items() if count}


def _owner(item: Item) -> tuple[str, int | None]:
    return item.name, None if item.food is None else item.order_id


def _owner_row(row: Mapping[str, Any]) -> tuple[str, int | None]:
    return row["name"], row["order_id"]


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        files = sorted(path.glob("*.json"))
        if not files:
            raise SystemExit(f"{path} holds no .json episodes: give a reference episode or a folder of them")
        return files
    if not path.exists():
        raise SystemExit(f"no such file or folder: {path}; give a reference episode or a folder of them")
    return [path]


def main(argv: list[str] | None = None, show: Callable[[str], None] = print) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, prog="agentspec.envs.deliverybench.replay", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--maps", type=Path, required=True, help="folder that holds one folder per city")
    parser.add_argument("--traces", type=Path, required=True, help="a reference episode, or a folder of them")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of lines")
    parser.add_argument("--all", action="store_true", help="list every mismatch, not only the first of each episode")
    options = parser.parse_args(argv)
    files = _files(options.traces)
    mismatches: list[dict[str, str]] = []
    matched = 0
    for file in files:
        trace = json.loads(file.read_text(encoding="utf-8"))
        found = replay(trace, options.maps, every=options.all)
        matched += not found
        mismatches.extend({"episode": file.name, "mismatch": text} for text in found)
        if not options.json:
            show(f"{file.name}: {'match' if not found else 'MISMATCH'} ({len(trace['steps'])} steps)")
            for text in found:
                show(f"  {text}")
    if options.json:
        show(json.dumps({"matched": matched, "total": len(files), "mismatches": mismatches}))
    else:
        show(f"{matched} of {len(files)} episodes match")
    return 0 if matched == len(files) else 1


if __name__ == "__main__":
    sys.exit(main())
