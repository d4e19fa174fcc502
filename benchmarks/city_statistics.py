"""Generated cities beside the originals': what orders look like there, and what the scripted couriers earn.

    python -m benchmarks.city_statistics [--json] [--cities 4] [--seeds 3] [--write docs/deliverybench.md]

Each row is a mean over cities of one size: the generated ones are the first of the test split, the originals are read
from ``../shared/deliverybench/maps`` and left out if they are not there. Orders are the first 200 of each order seed.
Profits are dollars per hour of one-hour shifts, with the standard deviation over all shifts. ``--write`` puts this
table and the table of rules into the marked sections of a document.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from agentspec.envs.deliverybench.city.citymap import City, load_city
from agentspec.envs.deliverybench.city.generate import SPLITS, generate
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier
from agentspec.envs.deliverybench.expert.scripted import luck
from agentspec.envs.deliverybench.world.orders import OrderBook
from agentspec.envs.deliverybench.world.rules import FAIR, quirk_table

REFERENCE_MAPS = Path(__file__).resolve().parents[1] / ".." / "shared" / "deliverybench" / "maps"
SIZES = ("tiny", "small", "medium", "large")
ORDERS = 200
SECTIONS = ("city statistics", "rules")
COUNTS = {"restaurant": "restaurants", "store": "stores", "charging_station": "chargers", "building": "buildings"}

Args = dict[str, Any]


def cities(count: int) -> list[tuple[str, list[tuple[City, Args]]]]:
    """Rows of the table: a title, and the cities with the environment arguments that select them."""
    rows: list[tuple[str, list[tuple[City, Args]]]] = []
    first = SPLITS["test"].start
    for size in SIZES:
        folders = sorted(REFERENCE_MAPS.glob(f"{size}-city-*")) if REFERENCE_MAPS.is_dir() else []
        if folders:
            rows.append((f"{size}, original ({len(folders)})", [(load_city(f), {"map": f}) for f in folders]))
        chosen = [(generate(size, s), {"size": size, "city_seed": s}) for s in range(first, first + count)]
        rows.append((f"{size}, generated ({count})", chosen))
    return rows


def order_figures(city: City, seeds: int) -> dict[str, list[float]]:
    """Way (m), pay ($), time limit (min) and preparation (min) of the first orders of each seed."""
    offers = [OrderBook(city, FAIR, seed)[n] for seed in range(seeds) for n in range(ORDERS)]
    return {
        "way": [offer.distance / 100.0 for offer in offers],
        "pay": [offer.pay for offer in offers],
        "limit": [offer.limit / 60.0 for offer in offers],
        "prep": [offer.prep / 60.0 for offer in offers],
    }


def profit(options: Args, courier_for: Callable[[City, int], Any], seed: int) -> tuple[float, int]:
    """Dollars per hour and deliveries of one shift."""
    env = DeliveryBenchEnv(observation="compact", **options)
    courier, ended = courier_for(env.city, seed), False
    _, info = env.reset(seed=seed)
    while not ended:
        _, _, terminated, truncated, info = env.step(courier.act(info))
        ended = terminated or truncated
    return info["metrics"]["hourly_profit"], info["metrics"]["deliveries"]


def row(title: str, members: Sequence[tuple[City, Args]], seeds: int) -> dict[str, Any]:
    """All figures of one kind of city."""
    result: dict[str, Any] = {"cities": title, "roads": statistics.mean(len(city.roads) for city, _ in members)}
    for kind, name in COUNTS.items():
        result[name] = statistics.mean(len(city.pois_of(kind)) for city, _ in members)
    figures = [order_figures(city, seeds) for city, _ in members]
    for name in ("way", "pay", "limit", "prep"):
        values = sorted(value for one in figures for value in one[name])
        result[name] = statistics.mean(values)
        result[f"{name}_p10"], result[f"{name}_p90"] = values[len(values) // 10], values[len(values) * 9 // 10]
    couriers = {
        "rule_based": ("fair", lambda city, seed: RuleBasedCourier(city)),
        "rule_based_original": ("original", lambda city, seed: RuleBasedCourier(city)),
        "random": ("fair", lambda city, seed: luck({}, random.Random(seed))),
    }
    for name, (rules, courier_for) in couriers.items():
        shifts = [
            profit({**options, "rules": rules}, courier_for, seed) for _, options in members for seed in range(seeds)
        ]
        earned = [dollars for dollars, _ in shifts]
        result[name], result[f"{name}_sd"] = statistics.mean(earned), statistics.stdev(earned)
        result[f"{name}_deliveries"] = statistics.mean(count for _, count in shifts)
        if not all(map(math.isfinite, earned)):
            raise ValueError(f"a shift in {title} earned no finite amount: {earned}")
    return result


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The figures as two Markdown tables: the cities with their orders, and the couriers."""
    head = ["cities", "roads", *COUNTS.values(), "way (m)", "pay ($)", "limit (min)", "preparation (min)"]
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    for r in rows:
        cells = [r["cities"], f"{r['roads']:.1f}", *(f"{r[name]:.1f}" for name in COUNTS.values())]
        for name, digits in (("way", 0), ("pay", 2), ("limit", 1), ("prep", 1)):
            cells.append(f"{r[name]:.{digits}f} ({r[f'{name}_p10']:.{digits}f}-{r[f'{name}_p90']:.{digits}f})")
        lines.append("| " + " | ".join(cells) + " |")
    head = ["cities", "rule-based, fair", "deliveries", "rule-based, original", "deliveries", "random, fair"]
    lines += ["", "| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    for r in rows:
        cells = [r["cities"]]
        for name in ("rule_based", "rule_based_original"):
            cells += [f"{r[name]:.0f} ± {r[f'{name}_sd']:.0f}", f"{r[f'{name}_deliveries']:.1f}"]
        cells.append(f"{r['random']:.0f} ± {r['random_sd']:.0f}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def fill(document: str, section: str, body: str) -> str:
    """The document with the lines between the markers of a section replaced.

    Raises:
        ValueError: the document lacks the markers.
    """
    begin, end = f"<!-- begin: {section} -->", f"<!-- end: {section} -->"
    before, found, rest = document.partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise ValueError(f"the document has no section {section!r}: put {begin} and {end} where it belongs")
    return f"{before}{begin}\n\n{body}\n\n{end}{after}"


def main(argv: Sequence[str] | None = None) -> None:
    """Measure and print the tables, or JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description="Generated cities beside the originals'.")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--cities", type=int, default=4, help="generated cities of each size")
    parser.add_argument("--seeds", type=int, default=3, help="order seeds (and shifts) of each city")
    parser.add_argument("--write", metavar="FILE", help="document whose marked sections are filled")
    options = parser.parse_args(argv)
    rows = [row(title, members, options.seeds) for title, members in cities(options.cities)]
    if options.write:
        path = Path(options.write)
        text = fill(path.read_text(encoding="utf-8"), "city statistics", table(rows))
        path.write_text(fill(text, "rules", quirk_table()), encoding="utf-8")
    print(json.dumps(rows, indent=1) if options.json else table(rows))


if __name__ == "__main__":
    main()
