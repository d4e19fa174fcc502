"""What it costs: Pareto fronts, tokens, dollars and time by module."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.metrics import PLAIN, primary_metric
from eval.report import figures
from eval.report.blocks import Block, Heading, Table
from eval.report.captions import LEVEL, name_of, unit_of
from eval.repricing import TAKEN, unpriced_note
from eval.statistics import Estimate
from eval.tables import summarise

Row = Mapping[str, Any]


def fronts_section(tasks: str, rows: Sequence[Row]) -> list[Block]:
    metric = primary_metric(rows)
    cells = summarise(rows, level=LEVEL)
    blocks: list[Block] = []
    for name in ("tokens", "thinking_s_per_step"):
        points = []
        for c in cells:
            cost = _tokens(c.estimates) if name == "tokens" else _mean(c.estimates.get(name))
            value = _mean(c.estimates.get(metric.name))
            if cost and value is not None and cost > 0:
                points.append((c.policy, c.scaffold, cost, value))
        if len(points) < 2:
            continue
        heading = "tokens per step, in and out" if name == "tokens" else PLAIN[name].heading
        blocks.append(
            figures.pareto(
                f"{name_of(tasks)}-pareto-{'tokens' if name == 'tokens' else 'time'}",
                points,
                x_heading=heading,
                y_heading=metric.heading,
                higher_is_better=metric.higher_is_better,
                caption=f"{tasks}: {metric.heading} against {heading}; means, {unit_of(rows).split(';')[0]}. "
                "Dashed: nobody is cheaper and as good.",
            )
        )
    return [Heading(f"{tasks}: what it costs", 3), *blocks] if blocks else []


def _tokens(estimates: Mapping[str, Estimate]) -> float | None:
    parts = [_mean(estimates.get(f"{side}_tokens_per_step")) for side in ("input", "output")]
    return None if None in parts else sum(p for p in parts if p is not None)


def _mean(estimate: Estimate | None) -> float | None:
    return None if estimate is None or math.isnan(estimate.mean) else estimate.mean


def costs_section(rows: Sequence[Row]) -> list[Block]:
    """Tokens, dollars and time by module."""
    body = []
    for policy, scaffold in dict.fromkeys((r["policy"], r["scaffold"]) for r in rows):
        sums: dict[str, list[float]] = {}
        steps = 0
        for row in rows:
            if (row["policy"], row["scaffold"]) == (policy, scaffold):
                steps += row.get("steps") or 0
                stepped = row["status"] == "completed"  # a failed episode has no count of its steps
                for module, taken in row.get("modules", {}).items():
                    total = sums.setdefault(module, [0.0] * 5)
                    for i, key in enumerate(TAKEN):
                        total[i] += taken[key] if stepped or i >= 3 else 0.0
        for module, (calls, tokens_in, tokens_out, dollars, seconds) in sums.items():
            per = max(1, steps)
            body.append(
                [
                    f"{policy} / {scaffold}",
                    module,
                    f"{calls / per:.2f}",
                    f"{tokens_in / per:,.0f}",
                    f"{tokens_out / per:,.1f}",
                    f"{dollars:.4f}",
                    f"{seconds:,.0f}",
                ]
            )
    if not body:
        return []
    header = [
        "policy / scaffold",
        "module",
        "calls/step",
        "tokens in/step",
        "tokens out/step",
        "$ in all",
        "seconds in all",
    ]
    return [
        Heading("Costs by module"),
        Table(
            header,
            body,
            "Per step of the completed episodes; in all: failed ones too. Seconds are wall-clock, batches shared. "
            + unpriced_note(rows),
        ),
    ]
