"""From rows of episodes to a report: which sections there are, what their tables and figures show.

Only what the rows support is drawn: a heat map of reasoning x memory needs two of each, failure shares need kept
trajectories, learning curves the folders of training runs. Every caption says over how many tasks, training runs and
repeats a number is taken, and what its interval is.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agentspec.files import file_digest, read_lines, write_atomic
from agentspec.metrics import PLAIN, Metric, columns, primary_metric
from eval.naming import slug
from eval.report import figures
from eval.report.blocks import Block, Figure, Heading, Table, Text, to_html, to_latex, to_markdown
from eval.report.sections import failures_section, learning_section, paper_section
from eval.statistics import Estimate, interactions, least_p, minimum_detectable_effect, runs_mean
from eval.tables import differences, differences_caption, show, show_p, summarise, values_by_run

Row = Mapping[str, Any]
LEVEL = 0.95


@dataclass(frozen=True)
class Report:
    """A report.

    Args:
        rows: of the episodes it is about.
    """

    title: str
    blocks: Sequence[Block]
    rows: Sequence[Row] = field(default_factory=tuple)


def build_report(
    results: str | Path,
    *,
    title: str = "",
    runs: Mapping[str, Sequence[str | Path]] | None = None,
    paper: bool = False,
) -> Report:
    """Read results and account for them.

    Args:
        results: folder of an evaluation, or its `results.jsonl`.
        runs: recipe -> folders of its training runs, for learning curves.
        paper: set the paper's numbers beside ours, in tables of their own.

    Raises:
        ValueError: no such file, or no episode in it.
    """
    path = Path(results)
    path = path / "results.jsonl" if path.is_dir() else path
    if not path.is_file():
        raise ValueError(f"there is no {path}; give the folder of an evaluation (agentspec eval --out FOLDER)")
    rows = read_lines(path)
    if not rows:
        raise ValueError(f"{path} has no episodes; nothing to report")
    blocks: list[Block] = [Heading(title or "Evaluation", 1), *_overview(rows, path)]
    for tasks in dict.fromkeys(str(row["tasks"]) for row in rows):
        members = [row for row in rows if row["tasks"] == tasks]
        blocks += [Heading(tasks), *_cells(tasks, members), *_modules(tasks, members), *_fronts(tasks, members)]
    blocks += _worlds(rows)
    blocks += learning_section(runs or {})
    blocks += failures_section(rows, path.parent, paper=paper)
    blocks += _costs(rows)
    if paper:
        blocks += paper_section(rows)
    return Report(title or "Evaluation", blocks, rows)


def write_files(report: Report, folder: str | Path) -> list[Path]:
    """Write `report.html`, `report.md`, `report.tex`, `episodes.csv`, `episodes.parquet` (with pyarrow), figures.

    Returns:
        what was written.
    """
    folder = Path(folder)
    drawn = [block for block in report.blocks if isinstance(block, Figure)]
    files: dict[str, str | bytes] = {
        "report.html": to_html(report.blocks, report.title),
        "report.md": to_markdown(report.blocks),
        "report.tex": to_latex(report.blocks),
        "episodes.csv": _csv(report.rows),
    }
    for figure in drawn:
        files |= {f"figures/{figure.name}.svg": figure.svg, f"figures/{figure.name}.png": figure.png}
    with contextlib.suppress(ImportError):  # the CSV says the same; pyarrow comes with the extra `train`
        files["episodes.parquet"] = _parquet(report.rows)
    for name, data in files.items():
        write_atomic(folder / name, data)
    return [folder / name for name in files]


# -- sections --------------------------------------------------------------------------------------


def _overview(rows: Sequence[Row], path: Path) -> list[Block]:
    statuses = [row["status"] for row in rows]
    counts = ", ".join(f"{statuses.count(s)} {s}" for s in ("completed", "failed", "unplayed") if s in statuses)
    body = []
    for policy in dict.fromkeys(row["policy"] for row in rows):
        mine = [row for row in rows if row["policy"] == policy]
        runs = {row.get("run", "") for row in mine}
        played = sum(row["status"] != "unplayed" for row in mine)
        body.append([policy, str(len(runs)), str(len({r["task"] for r in mine})), f"{played} of {len(mine)}"])
    agents = []
    for scaffold in dict.fromkeys(row["scaffold"] for row in rows):
        agent: Mapping[str, str] = next((r["agent"] for r in rows if r["scaffold"] == scaffold and _acts(r)), {})
        agents.append(
            [scaffold, *(str(agent.get(k, "–")) for k in ("reasoning", "memory", "reflection", "layout", "scope"))]
        )
    source = f"Made from `{path.name}` (SHA-256 `{file_digest(path)[:16]}`): {len(rows)} episodes, {counts}."
    return [
        Text(source),
        Table(["policy", "training runs", "tasks", "episodes played"], body, "What was played by whom."),
        Table(
            ["scaffold", "reasoning", "memory", "reflection", "layout", "scope"],
            agents,
            "Scaffolds. A scripted policy takes the place of their reasoning.",
        ),
    ]


def _acts(row: Row) -> bool:
    return bool(row.get("agent")) and row["agent"].get("reasoning") not in ("rule_based", "random")


def _unit(rows: Sequence[Row]) -> str:
    """What a caption says of the numbers: tasks, repeats, runs."""
    tasks = len({row["task"] for row in rows})
    repeats = len({row["rollout"] for row in rows})
    runs = {p: len({r.get("run", "") for r in rows if r["policy"] == p}) for p in {r["policy"] for r in rows}}
    several = max(runs.values())
    over = f" of up to {several} training runs" if several > 1 else ""
    unit = "over training runs where there are three and more, else over tasks" if several > 1 else "over tasks"
    return f"n = {tasks} tasks x {repeats} repeats{over}; {LEVEL:.0%} t intervals {unit}"


def _cells(tasks: str, rows: Sequence[Row]) -> list[Block]:
    cells, metric = summarise(rows, level=LEVEL), primary_metric(rows)
    policies, scaffolds = ([*dict.fromkeys(getattr(c, k) for c in cells)] for k in ("policy", "scaffold"))
    values = {(c.policy, c.scaffold): c.estimates[metric.name] for c in cells if metric.name in c.estimates}
    body = [[p, *(show(values.get((p, s)), metric.digits) for s in scaffolds)] for p in policies]
    unit = _unit(rows)
    blocks: list[Block] = [
        Heading(f"{tasks}: policy x scaffold", 3),
        Table(["policy", *scaffolds], body, f"{metric.heading}; {unit}."),
        figures.heat_map(
            f"{_name(tasks)}-matrix",
            policies,
            scaffolds,
            values,
            heading=metric.heading,
            digits=metric.digits,
            higher_is_better=metric.higher_is_better,
            caption=f"{tasks}: {metric.heading} by policy and scaffold; {unit}.",
        ),
    ]
    for by in ("policy", "scaffold"):
        compared = differences(rows, metric.name, by=by, level=LEVEL)
        if compared:
            blocks.append(_difference_table(compared, by, metric))
    blocks.append(_details(cells, columns(rows)))
    if text := _detectable(rows, metric):
        blocks.append(Text(text))
    return blocks


def _difference_table(compared: Sequence[Mapping[str, Any]], by: str, metric: Metric) -> Table:
    fixed = "scaffold" if by == "policy" else "policy"
    body = []
    for row in compared:
        numbers = [math.nan if row[k] is None else row[k] for k in ("mean", "low", "high", "p")]
        estimate = Estimate(numbers[0], numbers[1], numbers[2], row["n"])
        verdict = "tie" if row["tie"] else "higher" if row["mean"] > 0 else "lower"
        p = show_p(numbers[3])
        counted = f"{row['n']} {row['unit']}s"
        body.append([row[fixed], f"{row[by]} - {row['baseline']}", show(estimate, metric.digits), p, verdict, counted])
    caption = f"Differences in {metric.heading}, by {by}: {differences_caption(compared, LEVEL)}."
    return Table([fixed, "difference", "mean", "p", "verdict", "n"], body, caption)


def _details(cells: Sequence[Any], metrics: Sequence[Metric]) -> Table:
    shown = [m for m in metrics if any(m.name in c.estimates for c in cells)]
    body = []
    for c in cells:
        means = [c.estimates.get(m.name) for m in shown]
        numbers = ["–" if e is None else f"{e.mean:.{m.digits}f}" for m, e in zip(shown, means, strict=True)]
        body.append([c.policy, c.scaffold, str(c.episodes), str(c.failed), str(c.unplayed), str(c.cut_short), *numbers])
    header = ["policy", "scaffold", "episodes", "failed", "not played", "cut short", *(m.heading for m in shown)]
    return Table(header, body, "All figures, means. Failed episodes are in no mean; those cut short are.")


def _detectable(rows: Sequence[Row], metric: Metric) -> str:
    """How large a difference between two policies would have been found."""
    found: list[float] = []
    count = 0
    cells: dict[tuple[str, str], dict[str, float]] = {}
    for policy, scaffold in dict.fromkeys((r["policy"], r["scaffold"]) for r in rows):
        members = [r for r in rows if (r["policy"], r["scaffold"]) == (policy, scaffold)]
        runs = values_by_run(members, metric.name)
        if len(runs) == 1:
            cells[policy, scaffold] = next(iter(runs.values()))
    names = list(cells)
    for i, a in enumerate(names):
        for b in names[:i]:
            gaps = [cells[a][task] - cells[b][task] for task in cells[a] if task in cells[b]]
            if a[1] == b[1] and len(gaps) > 1:
                mean = math.fsum(gaps) / len(gaps)
                found.append(math.sqrt(math.fsum((g - mean) ** 2 for g in gaps) / (len(gaps) - 1)))
                count = max(count, len(gaps))
    if not found:
        return ""
    if least_p(count) > 1 - LEVEL:
        return f"{count} paired tasks are too few for any difference to be found by the sign-flip test, however large."
    deviation = statistics.median(found)
    if not deviation:
        return ""
    effect = minimum_detectable_effect(deviation, count)
    return (
        f"With {count} paired tasks and the median deviation of a difference ({deviation:.{metric.digits}f}), a "
        f"difference of {effect:.{metric.digits}f} in {metric.heading} would be found in four of five evaluations "
        "(before Holm's correction)."
    )


def _modules(tasks: str, rows: Sequence[Row]) -> list[Block]:
    """Reasoning x memory, per policy; reflection, if there is more than one."""
    blocks: list[Block] = []
    metric = primary_metric(rows)
    acting = [row for row in rows if _acts(row)]
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
                f"{_name(tasks)}-modules-{_name(policy)}",
                reasoning,
                memory,
                values,
                heading=metric.heading,
                digits=metric.digits,
                higher_is_better=metric.higher_is_better,
                caption=f"{policy}: {metric.heading} by reasoning and memory; {_unit(mine)}.",
            ),
            *_interactions(mine, metric),
        ]
    kinds = dict.fromkeys(row["agent"]["reflection"] for row in acting)
    if len(kinds) > 1:
        blocks += [Heading(f"{tasks}: reflection", 3), _reflection(tasks, acting, [*kinds], metric)]
    return blocks


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
        "over the table. Whatever else scaffolds differ in (layout, parameters) is averaged."
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
    caption = f"{tasks}: {metric.heading} by reflection, all scaffolds that have it together; {_unit(rows)}."
    return figures.bars(f"{_name(tasks)}-reflection", kinds, series, heading=metric.heading, caption=caption)


def _fronts(tasks: str, rows: Sequence[Row]) -> list[Block]:
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
                f"{_name(tasks)}-pareto-{'tokens' if name == 'tokens' else 'time'}",
                points,
                x_heading=heading,
                y_heading=metric.heading,
                higher_is_better=metric.higher_is_better,
                caption=f"{tasks}: {metric.heading} against {heading}; means, {_unit(rows).split(';')[0]}. "
                "Dashed: nobody is cheaper and as good.",
            )
        )
    return [Heading(f"{tasks}: what it costs", 3), *blocks] if blocks else []


def _tokens(estimates: Mapping[str, Estimate]) -> float | None:
    parts = [_mean(estimates.get(f"{side}_tokens_per_step")) for side in ("input", "output")]
    return None if None in parts else sum(p for p in parts if p is not None)


def _mean(estimate: Estimate | None) -> float | None:
    return None if estimate is None or math.isnan(estimate.mean) else estimate.mean


def _worlds(rows: Sequence[Row]) -> list[Block]:
    """Success in every world that has it."""
    having = [row for row in rows if row.get("success") is not None]
    worlds = [*dict.fromkeys(str(row["tasks"]) for row in having)]
    if not worlds:
        return []
    series: dict[str, dict[str, Estimate]] = {}
    for policy, scaffold in dict.fromkeys((r["policy"], r["scaffold"]) for r in having):
        for world in worlds:
            members = [r for r in having if (r["policy"], r["scaffold"], r["tasks"]) == (policy, scaffold, world)]
            runs = [v for v in values_by_run(members, "success").values() if v]
            if runs:
                series.setdefault(f"{policy} / {scaffold}", {})[world] = runs_mean(runs, level=LEVEL)
    body = [[name, *(show(values.get(w), 2) for w in worlds)] for name, values in series.items()]
    return [
        Heading("Success by world"),
        Table(["policy / scaffold", *worlds], body, f"Share of tasks achieved; {_unit(having)}."),
    ]


def _costs(rows: Sequence[Row]) -> list[Block]:
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
                    for i, key in enumerate(("calls", "input_tokens", "output_tokens", "cost", "latency_s")):
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
            "Per step of the completed episodes; in all: failed ones too. Seconds are wall-clock, batches shared.",
        ),
    ]


# -- data files ------------------------------------------------------------------------------------


def _flat(rows: Sequence[Row]) -> list[dict[str, Any]]:
    flat = []
    for row in rows:
        plain = {k: v for k, v in row.items() if not isinstance(v, Mapping | list)}
        plain |= {f"agent_{k}": v for k, v in row.get("agent", {}).items()}
        flat.append(plain | {"options": json.dumps(row.get("options", {}), sort_keys=True)})
    return flat


def _csv(rows: Sequence[Row]) -> str:
    flat = _flat(rows)
    names = list(dict.fromkeys(name for row in flat for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()


def _parquet(rows: Sequence[Row]) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    flat = _flat(rows)
    names: Iterable[str] = dict.fromkeys(name for row in flat for name in row)
    table = pa.table({name: pa.array([row.get(name) for row in flat]) for name in names})
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def _name(text: str) -> str:
    return slug(text).replace("_", "-")
