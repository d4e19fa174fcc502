"""Sections of a learning study: the paper's table form, the transfer matrix and its diagonal, what training did.

Drawn where a `study.json` lies beside the results (`recipes/learning_study.py` writes it): which policy was trained in
which scaffold, by which recipe, where its runs lie, what they took and what their audits found.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agentspec.metrics import Metric, primary_metric
from eval.report.blocks import Block, Heading, Table, Text
from eval.report.captions import LEVEL, unit_of
from eval.report.training import audits, read_study, taken, trained
from eval.statistics import LEAST_RUNS, Estimate, compare_runs, corrected, runs_mean
from eval.tables import show, show_p, values_by_run
from eval.transfer import Cells, at_home, diagonal

Row = Mapping[str, Any]
START = "start"


def transfer_section(rows: Sequence[Row], folder: Path) -> list[Block]:
    """All of it, for the study in `folder`; nothing where there is none."""
    study = read_study(folder)
    if not study:
        return []
    metric, home = primary_metric(rows), {a: item["scaffold"] for a, item in study["arms"].items()}
    grouped: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        grouped.setdefault((row["policy"], row["scaffold"]), []).append(row)
    values = {cell: values_by_run(members, metric.name) for cell, members in grouped.items()}
    return [
        Heading("Training and transfer"),
        *_paper_form(rows, study, values, metric),
        _matrix(rows, home, values, metric),
        *_diagonal(home, values, metric),
        *_gains(home, values, metric),
        *_comparisons(rows, study, values, metric),
        *trained(study, folder),
        *taken(rows, study, folder),
        *audits(study),
    ]


Values = Mapping[tuple[str, str], Mapping[str, Mapping[str, float]]]
"""(policy, scaffold) -> training run -> task -> value."""


def _estimate(values: Values, policy: str, scaffold: str) -> Estimate | None:
    runs = [v for v in values.get((policy, scaffold), {}).values() if v]
    return runs_mean(runs, level=LEVEL) if runs else None


def _tokens(rows: Sequence[Row], **where: str) -> str:
    """Mean tokens of an episode, in and out, of the rows that agree with `where` and were completed."""
    found = [r for r in rows if r["status"] == "completed" and all(r[k] == v for k, v in where.items())]
    total = sum((r.get("input_tokens") or 0) + (r.get("output_tokens") or 0) for r in found)
    return f"{total / len(found):,.0f}" if total else "–"


def _traced() -> str:
    return (
        "Every number is made of episodes: `episodes.csv` beside this report has them by `policy`, `run` and `scaffold`"
        ", with the `key` under which the store (`episodes.jsonl`) keeps each."
    )


def _paper_form(rows: Sequence[Row], study: Mapping[str, Any], values: Values, metric: Metric) -> list[Block]:
    named = study.get("table") or {}
    if not named:
        return []
    scaffolds = list(dict.fromkeys(r["scaffold"] for r in rows))
    acting = [r for r in rows if r["policy"] in named.values()]
    body = [
        [s, *(show(_estimate(values, p, s), metric.digits) for p in named.values()), _tokens(acting, scaffold=s)]
        for s in scaffolds
    ]
    trained = "; ".join(
        f"{heading}: {policy}"
        + (f", trained in {study['arms'][policy]['scaffold'] or 'several'}" if policy in study["arms"] else "")
        for heading, policy in named.items()
    )
    caption = f"The paper's form: {metric.heading} by evaluation scaffold; {trained}. {unit_of(acting)}. {_traced()}"
    return [Heading("The paper's table", 3), Table(["evaluated in", *named, "tokens/episode"], body, caption)]


def _matrix(rows: Sequence[Row], home: Mapping[str, str], values: Values, metric: Metric) -> Table:
    scaffolds = list(dict.fromkeys(r["scaffold"] for r in rows))
    body = []
    for policy in dict.fromkeys(r["policy"] for r in rows):
        shown = [show(_estimate(values, policy, s), metric.digits) for s in scaffolds]
        marked = [f"{v} (home)" if home.get(policy) == s else v for v, s in zip(shown, scaffolds, strict=True)]
        runs = max(len(values.get((policy, s), {})) for s in scaffolds)
        body.append([policy, home.get(policy) or "–", str(runs), *marked, _tokens(rows, policy=policy)])
    caption = f"Trained in (row) x evaluated in (column): {metric.heading}; {unit_of(rows)}. Means over the tasks that "
    caption += f"were completed. {_traced()}"
    return Table(["policy", "trained in", "runs", *scaffolds, "tokens/episode"], body, caption)


def _diagonal(home: Mapping[str, str], values: Values, metric: Metric) -> list[Block]:
    home = {arm: scaffold for arm, scaffold in home.items() if scaffold}
    homes = list(dict.fromkeys(home.values()))
    runs = {arm: sorted({run for s in homes for run in values.get((arm, s), {})}) for arm in home}
    cells: Cells = {
        arm: {run: {s: values.get((arm, s), {}).get(run, {}) for s in homes} for run in found}
        for arm, found in runs.items()
        if found
    }
    heading = Heading("Is a policy best where it was trained?", 3)
    try:
        found = diagonal(cells, home, level=LEVEL)
    except ValueError as error:
        return [heading, Text(f"Not tested: {error}.")]
    own = at_home(cells, home, level=LEVEL)
    tested = corrected([found.estimate, *own.values()])
    names = ["diagonal less the rest", *(f"{s}: trained there less trained elsewhere" for s in own)]
    body = [[name, *_difference(e, metric)] for name, e in zip(names, tested, strict=True)]
    lowest = 1 / found.assignments
    caption = (
        f"Differences in {metric.heading}; {LEVEL:.0%} t intervals, p corrected by Holm over this table. First row: a "
        "policy at home less the same policy in the other homes; how hard a scaffold is and how well an arm has learnt "
        "cancel (Satterthwaite's t over training runs). The others compare policies in one scaffold (Welch's t over "
        f"training runs), so how well an arm has learnt altogether is in them. With fewer than {LEAST_RUNS} runs of an "
        "arm: over tasks, this checkpoint only."
    )
    text = (
        f"Permutation of homes: of {found.assignments} assignments of homes to policies, a share of "
        f"{found.permutation:.3f} has a diagonal as far from 0 as the real one (it cannot be below {lowest:.3g}; not "
        "corrected)."
    )
    return [heading, Table(["difference", "mean", "p", "verdict", "n"], body, caption), Text(text)]


def _difference(estimate: Estimate, metric: Metric) -> list[str]:
    verdict = "–" if math.isnan(estimate.mean) else _verdict(estimate)
    counted = f"{estimate.n} {'tasks' if estimate.unit == 'seed' else 'runs'}"
    note = f"; {estimate.note}" if estimate.note else ""
    return [show(estimate, metric.digits), show_p(estimate.p), verdict, f"{counted}{note}"]


def _verdict(estimate: Estimate) -> str:
    return "tie" if estimate.tie(LEVEL) else "higher" if estimate.mean > 0 else "lower"


def _gains(home: Mapping[str, str], values: Values, metric: Metric) -> list[Block]:
    """Every arm less the start, in every scaffold."""
    found = {
        (arm, s): compare_runs([*filter(None, after.values())], [*filter(None, values[START, s].values())], level=LEVEL)
        for (arm, s), after in values.items()
        if arm in home and (START, s) in values
    }
    if not found:
        return []
    body = [
        [arm, f"{s} (home)" if home[arm] == s else s, *_difference(e, metric)]
        for (arm, s), e in zip(found, corrected([*found.values()]), strict=True)
    ]
    caption = (
        f"Gain over the start in {metric.heading}, on the same tasks; over training runs (fewer than {LEAST_RUNS}: "
    )
    caption += "over tasks, this checkpoint only); p corrected by Holm over this table."
    return [
        Heading("What training gained", 3),
        Table(["trained", "evaluated in", "gain", "p", "verdict", "n"], body, caption),
    ]


def _comparisons(rows: Sequence[Row], study: Mapping[str, Any], values: Values, metric: Metric) -> list[Block]:
    """Named pairs of policies, in every scaffold, beside how often each called its memory."""
    found: list[tuple[list[str], Estimate]] = []
    for name, (a, b) in (study.get("compare") or {}).items():
        for scaffold in dict.fromkeys(r["scaffold"] for r in rows):
            if (a, scaffold) in values and (b, scaffold) in values:
                first, second = ([*filter(None, values[p, scaffold].values())] for p in (a, b))
                names = [name, f"{b} - {a}", scaffold, _memory_calls(rows, b, scaffold)]
                found.append((names, compare_runs(second, first, level=LEVEL)))
    if not found:
        return []
    tested = corrected([e for _, e in found])
    body = [[*names, *_difference(e, metric)] for (names, _), e in zip(found, tested, strict=True)]
    caption = (
        f"Differences in {metric.heading} between two trained policies; Welch's t over training runs, p corrected by "
        "Holm over this table. Memory calls: of the first-named policy, per episode (in a scaffold with summaries, how "
        "many it wrote)."
    )
    header = ["question", "difference", "evaluated in", "memory calls/episode", "mean", "p", "verdict", "n"]
    return [Heading("Compared in pairs", 3), Table(header, body, caption)]


def _memory_calls(rows: Sequence[Row], policy: str, scaffold: str) -> str:
    mine = [r for r in rows if (r["policy"], r["scaffold"], r["status"]) == (policy, scaffold, "completed")]
    calls = sum(m["calls"] for r in mine for name, m in r.get("modules", {}).items() if name.startswith("memory."))
    return f"{calls / len(mine):.1f}" if mine else "–"
