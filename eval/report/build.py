"""From rows of episodes to a report: which sections there are, what their tables and figures show.

Only what the rows support is drawn: a heat map of reasoning x memory needs two of each, failure shares need kept
trajectories, learning curves the folders of training runs. Every caption says over how many tasks, training runs and
repeats a number is taken, and what its interval is.
"""

from __future__ import annotations

import contextlib
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agentspec.files import file_digest, read_lines, write_atomic
from agentspec.metrics import Metric, columns, primary_metric
from eval.report import figures
from eval.report.blocks import Block, Figure, Heading, Table, Text, to_html, to_latex, to_markdown
from eval.report.captions import LEVEL, acts, name_of, unit_of
from eval.report.costs import costs_section, fronts_section
from eval.report.data import as_csv, as_parquet
from eval.report.modules import modules_section
from eval.report.sections import failures_section, learning_section, paper_section
from eval.statistics import Estimate, least_p, minimum_detectable_effect, runs_mean
from eval.store import EPISODES
from eval.tables import difference_rows, differences, differences_caption, show, summarise, values_by_run

Row = Mapping[str, Any]


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
        if (path.parent / EPISODES).is_file():
            raise ValueError(f"the evaluation in {path.parent} has not ended; run its command again, it goes on")
        raise ValueError(f"there is no {path}; give the folder of an evaluation (agentspec eval --out FOLDER)")
    rows = read_lines(path)
    if not rows:
        raise ValueError(f"{path} has no episodes; nothing to report")
    blocks: list[Block] = [Heading(title or "Evaluation", 1), *_overview(rows, path)]
    for tasks in dict.fromkeys(str(row["tasks"]) for row in rows):
        members = [row for row in rows if row["tasks"] == tasks]
        blocks += [
            Heading(tasks),
            *_cells(tasks, members),
            *modules_section(tasks, members),
            *fronts_section(tasks, members),
        ]
    blocks += _worlds(rows)
    blocks += learning_section(runs or {})
    blocks += failures_section(rows, path.parent, paper=paper)
    blocks += costs_section(rows)
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
        "episodes.csv": as_csv(report.rows),
    }
    for figure in drawn:
        files |= {f"figures/{figure.name}.svg": figure.svg, f"figures/{figure.name}.png": figure.png}
    with contextlib.suppress(ImportError):  # the CSV says the same; pyarrow comes with the extra `train`
        files["episodes.parquet"] = as_parquet(report.rows)
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
        agent: Mapping[str, str] = next((r["agent"] for r in rows if r["scaffold"] == scaffold and acts(r)), {})
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


def _cells(tasks: str, rows: Sequence[Row]) -> list[Block]:
    cells, metric = summarise(rows, level=LEVEL), primary_metric(rows)
    policies, scaffolds = ([*dict.fromkeys(getattr(c, k) for c in cells)] for k in ("policy", "scaffold"))
    values = {(c.policy, c.scaffold): c.estimates[metric.name] for c in cells if metric.name in c.estimates}
    body = [[p, *(show(values.get((p, s)), metric.digits) for s in scaffolds)] for p in policies]
    unit = unit_of(rows)
    blocks: list[Block] = [
        Heading(f"{tasks}: policy x scaffold", 3),
        Table(["policy", *scaffolds], body, f"{metric.heading}; {unit}."),
        figures.heat_map(
            f"{name_of(tasks)}-matrix",
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
            caption = f"Differences in {metric.heading}, by {by}: {differences_caption(compared, LEVEL)}."
            blocks.append(Table(*difference_rows(compared, by, metric.digits), caption))
    blocks.append(_details(cells, columns(rows)))
    if text := _detectable(rows, metric):
        blocks.append(Text(text))
    return blocks


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
        Table(["policy / scaffold", *worlds], body, f"Share of tasks achieved; {unit_of(having)}."),
    ]
