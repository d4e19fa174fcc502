"""Rows of episodes -> cells of the matrix with intervals -> Markdown and JSON.

A table never hides what it leaves out: episodes that failed are counted beside the mean that excludes them, and so are
episodes that the scaffold's budget or the model's context cut short, which the mean includes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agentspec.files import write_atomic
from agentspec.metrics import CUT_SHORT, Metric, columns, primary_metric
from eval.repricing import unpriced_note
from eval.statistics import Estimate, compare_runs, corrected, least_p, paired_runs, runs_mean

Row = Mapping[str, Any]

DIFFERENCES = (
    "t interval; p corrected by Holm over the table. n in seeds: sign-flip test over tasks, about these checkpoints "
    "only; n in runs: t test over training runs"
)


@dataclass(frozen=True)
class CellSummary:
    """One policy under one scaffold on one set of tasks: an estimate per metric, and what is behind it.

    Args:
        runs: training runs that are this policy.
        unplayed: episodes that were not played (a limit was reached, or the cell broke down).
        metrics: says what the names in `estimates` are called and whether more is better, the primary one first.
    """

    tasks: str
    policy: str
    scaffold: str
    episodes: int
    failed: int
    cut_short: int
    estimates: Mapping[str, Estimate]
    metrics: tuple[Metric, ...] = ()
    runs: int = 1
    unplayed: int = 0

    def to_data(self) -> dict[str, Any]:
        """JSON values."""
        names = ("tasks", "policy", "scaffold", "episodes", "failed", "cut_short", "runs", "unplayed")
        data = {name: getattr(self, name) for name in names}
        return data | {"estimates": {name: e.to_data() for name, e in self.estimates.items()}}


def values_by_task(rows: Iterable[Row], metric: str) -> dict[str, float]:
    """Mean over the rollouts of each task; tasks without a number are left out."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if row.get("status") == "completed" and row.get(metric) is not None:
            found.setdefault(row["task"], []).append(float(row[metric]))
    return {task: math.fsum(values) / len(values) for task, values in found.items()}


def values_by_run(rows: Iterable[Row], metric: str) -> dict[str, dict[str, float]]:
    """Training run -> task -> mean over its rollouts; a policy that is no recipe of several runs has the run `""`."""
    runs: dict[str, list[Row]] = {}
    for row in rows:
        runs.setdefault(row.get("run", ""), []).append(row)
    return {run: values_by_task(members, metric) for run, members in runs.items()}


def summarise(rows: Sequence[Row], *, level: float = 0.95) -> list[CellSummary]:
    """All cells, in the order of their first rows; metrics without any number are left out of `estimates`.

    With three training runs and more an estimate is over the runs, else over the task seeds (see `eval.statistics`).
    """
    cells = []
    for (tasks, policy, scaffold), members in _grouped(rows).items():
        known = columns(members)
        values = {m.name: [v for v in values_by_run(members, m.name).values() if v] for m in known}
        estimates = {name: runs_mean(v, level=level) for name, v in values.items() if v}
        failed = sum(r["status"] == "failed" for r in members)
        unplayed = sum(r["status"] not in ("failed", "completed") for r in members)
        cut = sum(r["status"] == "completed" and r.get("ended") in CUT_SHORT for r in members)
        shown = tuple(metric for metric in known if metric.name in estimates)
        runs = len({r.get("run", "") for r in members})
        episodes = len(members) - unplayed
        cells.append(CellSummary(tasks, policy, scaffold, episodes, failed, cut, estimates, shown, runs, unplayed))
    return cells


def differences(
    rows: Sequence[Row], metric: str, *, by: str = "policy", level: float = 0.95, seed: int = 0
) -> list[dict[str, Any]]:
    """Paired differences to the first policy under the same scaffold (`by="scaffold"`: to the first scaffold).

    The p-values are corrected over the whole table, and `tie` says whether a difference was shown at `level`.

    Raises:
        ValueError: `by` is neither `"policy"` nor `"scaffold"`.
    """
    if by not in ("policy", "scaffold"):
        raise ValueError(f"by must be 'policy' or 'scaffold', got {by!r}")
    fixed = "scaffold" if by == "policy" else "policy"
    found: dict[tuple[str, str], dict[str, dict[str, dict[str, float]]]] = {}
    for (tasks, policy, scaffold), members in _grouped(rows).items():
        varied, held = (policy, scaffold) if by == "policy" else (scaffold, policy)
        runs = {run: values for run, values in values_by_run(members, metric).items() if values}
        found.setdefault((tasks, held), {})[varied] = runs
    named: list[tuple[dict[str, Any], Estimate]] = []
    for (tasks, held), values in found.items():
        baseline = next(iter(values))
        for name, mine in values.items():
            if name != baseline:
                other = values[baseline]
                if by == "policy":
                    compared = compare_runs([*mine.values()], [*other.values()], level=level, seed=seed)
                else:
                    compared = paired_runs(mine, other, level=level, seed=seed)
                named.append(({"tasks": tasks, fixed: held, by: name, "baseline": baseline}, compared))
    estimates = corrected([compared for _, compared in named])
    return [{**names, **e.to_data(), "tie": e.tie(level)} for (names, _), e in zip(named, estimates, strict=True)]


def differences_caption(compared: Sequence[Row], level: float = 0.95) -> str:
    """What stands over or under a table of differences; also, where it has too few tasks to show any, that it has."""
    least = min((len(compared) * least_p(row["n"]) for row in compared if row["n"]), default=1.0)
    if any(row["unit"] == "run" for row in compared) or least <= 1 - level:
        return DIFFERENCES
    needed = 1 + math.ceil(math.log2(len(compared) / (1 - level)))
    return (
        f"{DIFFERENCES}. So few tasks cannot give {len(compared)} differences a p below {min(1.0, least):.3f}: every "
        f"row is a tie whatever was measured; it takes {needed} tasks"
    )


def markdown(rows: Sequence[Row], *, level: float = 0.95) -> str:
    """The report: per set of tasks the matrix of the primary metric, all metrics, and paired differences."""
    if not rows:
        return "No episodes.\n"
    parts = ["# Evaluation", ""]
    for tasks in dict.fromkeys(row["tasks"] for row in rows):
        members = [r for r in rows if r["tasks"] == tasks]
        cells = summarise(members, level=level)
        metric = primary_metric(members)
        primary, heading, digits = metric.name, metric.heading, metric.digits
        parts += [f"## {tasks}: {heading}", "", f"{_unit(members)}, {level:.0%} t interval.", ""]
        parts += [*_world(members), ""]
        parts += [*_matrix(cells, primary, digits), "", *_details(cells), ""]
        parts += [note, ""] if (note := unpriced_note(members)) else []
        for by in ("policy", "scaffold"):
            compared = differences(members, primary, by=by, level=level)
            if compared:
                caption = differences_caption(compared, level)
                parts += [f"Paired differences in {heading}, by {by} ({caption}):", ""]
                parts += [*table(*difference_rows(compared, by, digits)), ""]
    return "\n".join(parts)


def _unit(rows: Sequence[Row]) -> str:
    """Over what means and intervals are taken."""
    runs = max(len({r.get("run", "") for r in rows if r["policy"] == policy}) for policy in {r["policy"] for r in rows})
    return "Mean over the tasks that were completed" + (
        " (over training runs where a policy has three and more)" if runs > 1 else ""
    )


def _world(rows: Sequence[Row]) -> list[str]:
    """What was played: environment, options and, where the environment has them, the rule set."""
    lines = []
    for row in rows:
        options = ", ".join(f"{k} {v}" for k, v in sorted((row.get("options") or {}).items()))
        rules = (row.get("env_metrics") or {}).get("rules")
        stated = f"; rules: {rules}." if rules else "."
        lines.append(f"World: {row.get('env', '')} ({options or 'defaults'}){stated}")
    return list(dict.fromkeys(lines))[:4]


def write_report(rows: Sequence[Row], folder: str | Path, *, level: float = 0.95) -> None:
    """Write ``results.md`` and ``summary.json`` beside ``results.jsonl``."""
    folder = Path(folder)
    write_atomic(folder / "results.md", markdown(rows, level=level))
    metrics = [
        {"name": m.name, "unit": m.unit, "heading": m.heading, "higher_is_better": m.higher_is_better}
        for m in columns(rows)
    ]
    data = {"level": level, "metrics": metrics, "cells": [c.to_data() for c in summarise(rows, level=level)]}
    write_atomic(folder / "summary.json", json.dumps(data, indent=2, sort_keys=True) + "\n")


def show(estimate: Estimate | None, digits: int) -> str:
    """``12.3 [10.1, 14.8]``; a dash where there is no number, and no interval for a single task."""
    if estimate is None or math.isnan(estimate.mean):
        return "–"
    mean = f"{estimate.mean:.{digits}f}"
    if math.isnan(estimate.low):
        return mean
    return f"{mean} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def show_p(p: float | None) -> str:
    """`0.012`; `<0.001` below that, a dash where there is none."""
    if p is None or math.isnan(p):
        return "–"
    return f"{p:.3f}" if p >= 0.001 else "<0.001"


def _grouped(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[Row]]:
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["tasks"], row["policy"], row["scaffold"]), []).append(row)
    return groups


def _matrix(cells: Sequence[CellSummary], metric: str, digits: int) -> list[str]:
    scaffolds = list(dict.fromkeys(c.scaffold for c in cells))
    by = {(c.policy, c.scaffold): c for c in cells}
    body = [
        [policy, *(show(by[policy, s].estimates.get(metric), digits) if (policy, s) in by else "–" for s in scaffolds)]
        for policy in dict.fromkeys(c.policy for c in cells)
    ]
    return table(["policy", *scaffolds], body)


def metrics_of(cells: Sequence[CellSummary]) -> list[Metric]:
    """The metrics of any of the cells, in the order of tables."""
    found = {metric.name: metric for cell in cells for metric in cell.metrics}
    order = max((cell.metrics for cell in cells), key=len, default=())
    return [*order, *(metric for metric in found.values() if metric not in order)]


def _details(cells: Sequence[CellSummary]) -> list[str]:
    metrics = metrics_of(cells)
    header = ["policy", "scaffold", "runs", "episodes", "failed", "cut short", *(m.heading for m in metrics)]
    body = []
    for c in cells:
        means = [c.estimates.get(m.name) for m in metrics]
        shown = ["–" if e is None else f"{e.mean:.{m.digits}f}" for m, e in zip(metrics, means, strict=True)]
        left_out = f" ({c.unplayed} not played)" if c.unplayed else ""
        counted = [str(c.runs), f"{c.episodes}{left_out}", str(c.failed), str(c.cut_short)]
        body.append([c.policy, c.scaffold, *counted, *shown])
    return table(header, body)


def difference_rows(compared: Sequence[Row], by: str, digits: int) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table of differences; the verdict is a dash where there is nothing to compare."""
    fixed = "scaffold" if by == "policy" else "policy"
    body = []
    for row in compared:
        numbers = [math.nan if row[k] is None else row[k] for k in ("mean", "low", "high")]
        estimate = Estimate(numbers[0], numbers[1], numbers[2], row["n"])
        verdict = "–" if row["mean"] is None else "tie" if row["tie"] else "higher" if row["mean"] > 0 else "lower"
        counted = f"{row['n']} {row['unit']}s"
        names = [row[fixed], f"{row[by]} - {row['baseline']}"]
        body.append([*names, show(estimate, digits), show_p(row["p"]), verdict, counted])
    return [fixed, "difference", "mean", "p", "verdict", "n"], body


def table(header: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table; ``|`` in a cell is escaped."""
    lines = [list(header), ["---"] * len(header), *(list(row) for row in body)]
    return ["| " + " | ".join(c.replace("|", "\\|") for c in line) + " |" for line in lines]
