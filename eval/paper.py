"""The numbers of the AgentSpec paper, and what they support.

`data/paper.csv` holds every number of the paper's result tables and plots, one per row (`COLUMNS`), with our names of
modules. They are means of three runs at most, and no spread is printed: nothing here has an interval over runs. What
can be computed is computed: values that are printed twice, configurations that are printed in two tables with different
values, contrasts over backbones or scaffolds as units, how much of a table an additive model explains.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np

FILE = Path(__file__).with_name("data") / "paper.csv"
SOURCE = "AgentSpec paper, tables and plots as printed; read off by hand"
COLUMNS = ("table", "environment", "backbone", "reasoning", "memory", "reflection", "policy", "metric", "value", "note")
PROFIT = "hourly_profit"
"""The paper's own name of its figure; as a word of the paper it may stand here."""
CONFIGURATION = ("environment", "backbone", "reasoning", "memory", "reflection", "policy", "metric")

Scaffold = tuple[str, str, str]
"""(reasoning, memory, reflection)."""


@dataclass(frozen=True)
class Number:
    """One printed number (a count `k/n` as its share)."""

    table: str
    environment: str
    backbone: str
    reasoning: str
    memory: str
    reflection: str
    policy: str
    metric: str
    value: float
    note: str

    @property
    def scaffold(self) -> Scaffold:
        """Reasoning, memory, reflection."""
        return self.reasoning, self.memory, self.reflection


@cache
def numbers() -> tuple[Number, ...]:
    """All of them, in the order of the file."""
    with open(FILE, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return tuple(Number(**{**row, "value": float(Fraction(row["value"]))}) for row in rows)  # type: ignore[arg-type]


def table(name: str, metric: str = "", policy: str = "") -> dict[tuple[str, Scaffold], float]:
    """(backbone, scaffold) -> value of one of the paper's tables.

    Raises:
        ValueError: no such table.
    """
    found = [n for n in numbers() if n.table == name]
    if not found:
        raise ValueError(f"no table {name!r}; there are {', '.join(dict.fromkeys(n.table for n in numbers()))}")
    chosen = [n for n in found if metric in ("", n.metric) and policy in ("", n.policy)]
    return {(n.backbone, n.scaffold): n.value for n in chosen}


def metric_of(world: str) -> str:
    """What the paper's result tables print for a world, by the paper's name."""
    return PROFIT if world == "deliverybench" else "success_rate"


def printed_alike(metric: str = PROFIT, least: int = 5) -> list[tuple[str, str, int]]:
    """Pairs of tables that print the same values for different backbones: (table, table, number of values)."""
    tables = {
        name: {n.scaffold: n.value for n in numbers() if n.table == name and n.metric == metric}
        for name in dict.fromkeys(n.table for n in numbers() if n.metric == metric)
        if len({n.backbone for n in numbers() if n.table == name}) == 1
    }
    found = []
    for (a, mine), (b, theirs) in itertools.combinations(tables.items(), 2):
        common = mine.keys() & theirs.keys()
        if len(common) >= least and all(mine[s] == theirs[s] for s in common):
            found.append((a, b, len(common)))
    return found


def printed_twice(metric: str) -> list[tuple[Number, Number]]:
    """Configurations that stand in two tables: same world, backbone, modules, policy and metric."""
    found: dict[tuple[str, ...], list[Number]] = {}
    for n in numbers():
        if n.metric == metric:
            found.setdefault(tuple(getattr(n, c) for c in CONFIGURATION), []).append(n)
    pairs = [pair for members in found.values() for pair in itertools.combinations(members, 2)]
    return [(a, b) for a, b in pairs if a.table != b.table]


def is_rounding(a: Number, b: Number) -> bool:
    """Whether two prints are one number with more and fewer digits."""
    return abs(a.value - b.value) < 0.01


def replication_deviation(pairs: Iterable[tuple[Number, Number]]) -> float:
    """Standard deviation of one printed value, from the differences of values printed twice: `sqrt(mean(d^2) / 2)`."""
    squares = [(a.value - b.value) ** 2 for a, b in pairs]
    return math.sqrt(math.fsum(squares) / len(squares) / 2) if squares else math.nan


def additive_shares(cells: Mapping[tuple[str, str], float]) -> dict[str, float]:
    """How much of the variance of a complete two-way table its rows, its columns and neither explain.

    Returns:
        `rows`, `columns`, `rest` (shares of the sum of squares about the mean) and `rest_deviation` (root of the rest's
        mean square, over its (r - 1)(c - 1) degrees of freedom). With one value per cell the rest is interaction and
        noise together; nothing can part them.
    """
    first, second = (list(dict.fromkeys(key[i] for key in cells)) for i in (0, 1))
    grid = np.array([[cells[a, b] for b in second] for a in first])
    mean = grid.mean()
    rows, columns = grid.mean(axis=1, keepdims=True) - mean, grid.mean(axis=0, keepdims=True) - mean
    rest = grid - mean - rows - columns
    total = float(((grid - mean) ** 2).sum())
    freedom = (len(first) - 1) * (len(second) - 1)
    return {
        "rows": float((rows**2).sum() * len(second)) / total,
        "columns": float((columns**2).sum() * len(first)) / total,
        "rest": float((rest**2).sum()) / total,
        "rest_deviation": math.sqrt(float((rest**2).sum()) / freedom),
    }


def agreement(columns: Sequence[Mapping[Scaffold, float]]) -> tuple[float, float, dict[Scaffold, float]]:
    """Do backbones rank the scaffolds alike? Kendall's W (1: all the same), the p-value of Friedman's test, mean ranks.

    Args:
        columns: scaffold -> value, one per backbone; scaffolds that one of them lacks are left out. Rank 1 is the best.
    """
    from scipy import stats

    common = [s for s in columns[0] if all(s in column for column in columns)]
    values = np.array([[column[s] for s in common] for column in columns])
    test = stats.friedmanchisquare(*values.T)
    ranks = np.array([stats.rankdata(-row) for row in values]).mean(axis=0)
    w = float(test.statistic) / (len(columns) * (len(common) - 1))
    return w, float(test.pvalue), dict(zip(common, map(float, ranks), strict=True))


def impossible_rates(environment: str, tasks: int, rounds: int = 1) -> list[Number]:
    """Printed success rates that no count of successes over `rounds` of all tasks gives, at one digit."""
    possible = {round(k / (tasks * rounds), 1) for k in range(tasks * rounds + 1)}
    rates = [n for n in numbers() if n.environment == environment and n.metric == "success_rate"]
    return [n for n in rates if round(n.value, 1) not in possible]
