"""What the paper prints of single DeliveryBench episodes, beside what this world computes.

    python -m benchmarks.paper_facts [--json] [--maps DIR] [--write docs/deliverybench.md]

The paper's case studies are of the city medium-city-22. The seed printed there is not the seed of the orders: orders
match the number of the agent that ran, or the original's own unseeded sequence. Rows of the map's orders are left out
where the map is not there (default: ``../shared/deliverybench/maps``). The exit status is 0 only if all rows agree.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from agentspec.envs.deliverybench.city.citymap import load_city
from agentspec.envs.deliverybench.world.orders import Offer, OrderBook
from agentspec.envs.deliverybench.world.rules import ORIGINAL

MAPS = Path(__file__).resolve().parents[1] / ".." / "shared" / "deliverybench" / "maps"
CITY = "medium-city-22"
SECTION = "paper facts"


@dataclass(frozen=True)
class Fact:
    """One printed figure: what it is of, the order seed that gives it ("any": rules), and both values as text."""

    fact: str
    seed: str
    printed: str
    ours: str

    @property
    def agrees(self) -> bool:
        """Whether both texts are equal."""
        return self.printed == self.ours


def rule_facts() -> list[Fact]:
    """Figures of the rules alone."""
    rules = ORIGINAL
    metres = 60.0 / rules.battery_per_m
    return [
        Fact("price of charging", "any", "0.05 $/%", f"{rules.charge_price:g} $/%"),
        Fact("speed of charging", "any", "7.5 %/min", f"{rules.charge_per_min:g} %/min"),
        Fact("speed of the e-scooter", "any", "6 m/s", f"{rules.speed['e-scooter'] / 100.0:g} m/s"),
        Fact("way on 60 % of the battery", "any", "1,500 m", f"{metres:,.0f} m"),
    ]


def order_facts(maps: Path) -> list[Fact]:
    """Figures of orders in the paper's city.

    Raises:
        MapError: the city is not in `maps`.
    """
    city = load_city(maps / CITY)

    def order(seed: int | None, number: int) -> Offer:
        return OrderBook(city, ORIGINAL, seed)[number]

    def terms(seed: int, number: int) -> str:
        offer = order(seed, number)
        return f"${offer.pay:.2f}, {math.ceil(offer.limit / 60.0)} min"

    def dishes(seed: int, number: int) -> str:
        return ", ".join(sorted(food.name for food in order(seed, number).foods))

    first, donut = order(5, 0), order(1, 29)
    kitchen = order(11, 1)
    start, bonus = ORIGINAL.initial_balance, ORIGINAL.bonus[5]
    rows = [
        Fact("order 0", "5", "$11.29, 17 min", terms(5, 0)),
        Fact("order 0: way from door to door", "5", "1388.7 m", f"{first.distance / 100.0:.1f} m"),
        Fact("order 1: pay, ready in", "11", "$15.89, 1 min", f"${kitchen.pay:.2f}, {kitchen.prep / 60.0:.0f} min"),
        Fact("balance after a first delivery of order 17", "1", "$112.28", f"${start + order(1, 17).pay + bonus:.2f}"),
        Fact("order 29: pay, way", "1", "$4.08, 427.3 m", f"${donut.pay:.2f}, {donut.distance / 100.0:.1f} m"),
        Fact("order 29: dishes", "1", "Curry, Donut", dishes(1, 29)),
        Fact("order 4: dishes", "1", "Curry", dishes(1, 4)),
        Fact("order 5: dishes", "1", "Milkshake, Pizza, PokeBowl", dishes(1, 5)),
    ]
    printed = {8: "$8.51, 18 min", 0: "$8.06, 9 min", 11: "$7.98, 11 min", 13: "$6.04, 8 min"}
    rows += [Fact(f"order {number}", "4", text, terms(4, number)) for number, text in printed.items()]
    for number, text in ((7, "restaurant 4, 4 min"), (8, "restaurant 4, 7 min")):
        offer = order(None, number)
        ours = f"{offer.pickup.name}, {offer.prep / 60.0:.0f} min"
        rows.append(Fact(f"order {number}: where, ready in", "unseeded", text, ours))
    return rows


def table(rows: Sequence[Fact]) -> str:
    """The facts as a Markdown table."""
    lines = ["| fact | order seed | paper | this world |", "|---|---|---|---|"]
    return "\n".join([*lines, *(f"| {row.fact} | {row.seed} | {row.printed} | {row.ours} |" for row in rows)])


def written(document: str, rows: Sequence[Fact]) -> str:
    """`document` with the table in its marked section.

    Raises:
        ValueError: the document has no such section.
    """
    begin, end = f"<!-- begin: {SECTION} -->", f"<!-- end: {SECTION} -->"
    if begin not in document or end not in document:
        raise ValueError(f"the document has no section {begin} ... {end}")
    head, _, rest = document.partition(begin)
    return f"{head}{begin}\n\n{table(rows)}\n\n{end}{rest.partition(end)[2]}"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the facts, and write them into a document where asked to."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.partition("\n")[0])
    parser.add_argument("--maps", type=Path, default=MAPS)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--write", type=Path, help="document whose marked section is replaced")
    arguments = parser.parse_args(argv)
    there = (arguments.maps / CITY).is_dir()
    rows = [*(order_facts(arguments.maps) if there else []), *rule_facts()]
    print(json.dumps([{**asdict(row), "agrees": row.agrees} for row in rows]) if arguments.json else table(rows))
    if not there:
        print(f"{CITY} is not in {arguments.maps}: the facts about its orders are left out")
    elif arguments.write is not None:
        text = written(arguments.write.read_text(encoding="utf-8"), rows)
        arguments.write.write_text(text, encoding="utf-8")
    return 0 if all(row.agrees for row in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
