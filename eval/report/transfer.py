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
from eval.statistics import LEAST_RUNS, Cells, Diagonal, Estimate, at_home, compare_runs, corrected, diagonal, runs_mean
from eval.tables import VERDICTS, show, show_p, values_by_run

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
    lacking = [arm for arm in home if not any(arm == policy for policy, _ in values)]
    return [
        Heading("Training and transfer"),
        *([Text(f"No run of {', '.join(lacking)} was evaluated: left out of all tables.")] if lacking else []),
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


def _played(values: Values, policy: str, scaffold: str) -> list[Mapping[str, float]]:
    """Values by task of the runs that completed an episode there."""
    return [v for v in values.get((policy, scaffold), {}).values() if v]


def _estimate(values: Values, policy: str, scaffold: str) -> Estimate | None:
    runs = _played(values, policy, scaffold)
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
    runs: dict[str, list[str]] = {}
    for (policy, _), played in values.items():
        if home.get(policy):  # not dealt out over several
            runs[policy] = sorted({*runs.get(policy, ()), *played})
    homes = list(dict.fromkeys(home[arm] for arm in runs))
    cells: Cells = {
        arm: {run: {s: values.get((arm, s), {}).get(run, {}) for s in homes} for run in found}
        for arm, found in runs.items()
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
    caption = (
        f"Differences in {metric.heading}; {LEVEL:.0%} t intervals, p corrected by Holm over this table; {VERDICTS}. "
        "First row: a policy at home less the same policy in the other homes; how hard a scaffold is and how well an "
        "arm has learnt cancel. The others compare policies in one scaffold, so how well an arm has learnt altogether "
        "is in them. Each arm is a sample of runs (Satterthwaite's t); with fewer than "
        f"{LEAST_RUNS} runs of an arm: over tasks (sign-flip test), this checkpoint only."
    )
    table = Table(["difference", "mean", "p", "verdict", "n"], body, caption)
    return [heading, table, Text(_permuted(found, len(homes)))]


def _permuted(found: Diagonal, homes: int) -> str:
    if math.isnan(found.permutation):
        return f"Permutation of homes: not possible with {homes} homes, all of whose assignments are as far from 0."
    some = "" if found.tried == found.assignments else f" {found.tried:,} drawn at random from"
    return (
        f"Permutation of homes: of{some} {found.assignments:,} assignments of homes to policies, a share of "
        f"{show_p(found.permutation)} has a diagonal as far from 0 as the real one (it cannot be below "
        f"{found.least:.2g}; not corrected)."
    )


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
        (arm, s): compare_runs(_played(values, arm, s), _played(values, START, s), fixed=True, level=LEVEL)
        for arm, s in values
        if arm in home and (START, s) in values
    }
    if not found:
        return []
    body = [
        [arm, f"{s} (home)" if home[arm] == s else s, *_difference(e, metric)]
        for (arm, s), e in zip(found, corrected([*found.values()]), strict=True)
    ]
    caption = (
        f"Gain over the start in {metric.heading}, on the same tasks. All runs begin with the start, so it is a "
        f"constant and each run has one gain: t over training runs (fewer than {LEAST_RUNS}: sign-flip test over "
        f"tasks, this checkpoint only); p corrected by Holm over this table; {VERDICTS}."
    )
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
                sides = _played(values, b, scaffold), _played(values, a, scaffold)
                names = [name, f"{b} - {a}", scaffold, _memory_calls(rows, b, scaffold)]
                fixed = not {a, b} <= set(study["arms"])  # the start, or a scripted policy
                found.append((names, compare_runs(*sides, fixed=fixed, level=LEVEL)))
    if not found:
        return []
    tested = corrected([e for _, e in found])
    body = [[*names, *_difference(e, metric)] for (names, _), e in zip(found, tested, strict=True)]
    caption = (
        f"Differences in {metric.heading} between two policies; Welch's t over training runs (fewer than {LEAST_RUNS} "
        "of an arm: sign-flip test over tasks, this checkpoint only), p corrected by Holm over this table; "
        f"{VERDICTS}. Memory calls: of the first-named policy, per episode (in a scaffold with summaries, how many it "
        "wrote)."
    )
    header = ["question", "difference", "evaluated in", "memory calls/episode", "mean", "p", "verdict", "n"]
    return [Heading("Compared in pairs", 3), Table(header, body, caption)]


def _memory_calls(rows: Sequence[Row], policy: str, scaffold: str) -> str:
    mine = [r for r in rows if (r["policy"], r["scaffold"], r["status"]) == (policy, scaffold, "completed")]
    calls = sum(m["calls"] for r in mine for name, m in r.get("modules", {}).items() if name.startswith("memory."))
    return f"{calls / len(mine):.1f}" if mine else "–"
