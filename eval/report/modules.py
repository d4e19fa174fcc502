"""What modules do, per policy: reasoning x memory with interactions, reflection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.metrics import Metric, primary_metric
from eval.report import figures
from eval.report.blocks import Block, Figure, Heading, Table, Text
from eval.report.captions import LEVEL, acts, name_of, unit_of
from eval.statistics import Estimate, interactions, runs_mean
from eval.tables import VERDICTS, show, show_p, values_by_run

Row = Mapping[str, Any]


def modules_section(tasks: str, rows: Sequence[Row]) -> list[Block]:
    """Reasoning x memory, per policy; reflection, if there is more than one."""
    blocks: list[Block] = []
    metric = primary_metric(rows)
    acting = [row for row in rows if acts(row)]
    for policy in dict.fromkeys(row["policy"] for row in acting):
        mine = [row for row in acting if row["policy"] == policy and row["agent"]["reflection"] == "none"]
        reasoning, memory = ([*dict.fromkeys(r["agent"][k] for r in mine)] for k in ("reasoning", "memory"))
        if len(reasoning) < 2 or len(memory) < 2:
            continue
        values = {}
        for a in reasoning:
            for b in memory:
                members = [r for r in mine if (r["agent"]["reasoning"], r["agent"]["memory"]) == (a, b)]
                runs = [v for v in values_by_run(members, metric.name).values() if v]
                if runs:
                    values[a, b] = runs_mean(runs, level=LEVEL)
        blocks += [
            Heading(f"{tasks}: reasoning x memory, {policy}", 3),
            figures.heat_map(
                f"{name_of(tasks)}-modules-{name_of(policy)}",
                reasoning,
                memory,
                values,
                heading=metric.heading,
                digits=metric.digits,
                higher_is_better=metric.higher_is_better,
                caption=f"{policy}: {metric.heading} by reasoning and memory; {unit_of(mine)}.{pooled(mine)}",
            ),
            *_interactions(mine, metric),
        ]
    kinds = dict.fromkeys(row["agent"]["reflection"] for row in acting)
    if len(kinds) > 1:
        blocks += [Heading(f"{tasks}: reflection", 3), _reflection(tasks, acting, [*kinds], metric)]
    return blocks


def pooled(rows: Sequence[Row]) -> str:
    """What else differs between the cells of reasoning x memory, or within one, as sentences; empty if nothing does."""
    said = []
    for key in ("layout", "scope"):
        cells: dict[str, set[str]] = {}
        for row in rows:
            agent = row["agent"]
            cells.setdefault(f"{agent['reasoning']} x {agent['memory']}", set()).add(str(agent.get(key, "")))
        groups: dict[str, list[str]] = {}
        for cell, values in cells.items():
            groups.setdefault(" and ".join(sorted(values)), []).append(cell)
        if len(groups) > 1 or any(len(values) > 1 for values in cells.values()):
            most = max(groups, key=lambda value: len(groups[value]))
            others = [f"{value} in {', '.join(of)}" for value, of in groups.items() if value != most]
            where = "; ".join([*others, f"{most} in {'the others' if others else 'all cells, pooled'}"])
            said.append(f" Scaffolds differ in {key} too ({where}), so a difference need not be the module's.")
    return "".join(said)


def _interactions(rows: Sequence[Row], metric: Metric) -> list[Block]:
    flat = [
        {
            "seed": r.get("run") or r["task"],
            "reasoning": r["agent"]["reasoning"],
            "memory": r["agent"]["memory"],
            "y": r[metric.name],
        }
        for r in rows
        if r["status"] == "completed" and r.get(metric.name) is not None
    ]
    try:
        found = interactions(flat, "y", ("reasoning", "memory"))
    except ValueError as error:
        return [Text(f"Interactions are not estimated: {error}.")]
    body = [
        [f"{a} x {b}", show(e, metric.digits), show_p(e.p), "tie" if e.tie() else "interaction"]
        for (a, b), e in found.items()
    ]
    caption = (
        f"Interactions in {metric.heading}: how far a combination is from the sum of its parts; OLS, errors clustered "
        f"by task (by training run where there are runs; {next(iter(found.values())).n} clusters), p corrected by Holm "
        f"over the table; {VERDICTS}. Whatever else scaffolds differ in (layout, parameters) is averaged."
    )
    return [Table(["combination", "effect", "p", "verdict"], body, caption)]


def _reflection(tasks: str, rows: Sequence[Row], kinds: Sequence[str], metric: Metric) -> Figure:
    series: dict[str, dict[str, Estimate]] = {}
    for policy in dict.fromkeys(row["policy"] for row in rows):
        for kind in kinds:
            members = [r for r in rows if r["policy"] == policy and r["agent"]["reflection"] == kind]
            runs = [v for v in values_by_run(members, metric.name).values() if v]
            if runs:
                series.setdefault(policy, {})[kind] = runs_mean(runs, level=LEVEL)
    caption = f"{tasks}: {metric.heading} by reflection, all scaffolds that have it together; {unit_of(rows)}."
    return figures.bars(f"{name_of(tasks)}-reflection", kinds, series, heading=metric.heading, caption=caption)
