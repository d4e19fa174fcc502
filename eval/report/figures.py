"""Figures of a report: drawn once, as SVG and PNG, in colours that the colour-blind can tell apart.

Every series has its own marker or hatch besides its colour (Okabe and Ito's palette; `viridis` and its reverse for
heat maps, with the numbers written in).
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.report.blocks import Figure
from eval.statistics import Estimate

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
HATCHES = ("", "//", "..", "xx", "\\\\", "++", "oo", "--")


def heat_map(
    name: str,
    rows: Sequence[str],
    columns: Sequence[str],
    values: Mapping[tuple[str, str], Estimate],
    *,
    heading: str,
    digits: int,
    higher_is_better: bool,
    caption: str,
) -> Figure:
    """Values by row and column with their intervals written in; brighter is better; empty where there is none."""
    figure, axes = _figure(2.4 + 1.35 * len(columns), 1.4 + 0.62 * len(rows))
    grid = np.full((len(rows), len(columns)), np.nan)
    for (row, column), estimate in values.items():
        grid[rows.index(row), columns.index(column)] = estimate.mean
    image = axes.imshow(grid, cmap="viridis" if higher_is_better else "viridis_r", aspect="auto")
    for (row, column), e in values.items():
        if math.isnan(e.mean):
            continue
        text = f"{e.mean:.{digits}f}" + ("" if math.isnan(e.low) else f"\n[{e.low:.{digits}f}, {e.high:.{digits}f}]")
        red, green, blue, _ = image.cmap(image.norm(e.mean))
        dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
        at = (columns.index(column), rows.index(row))
        axes.text(*at, text, ha="center", va="center", fontsize=7.5, color="white" if dark else "black")
    axes.set_xticks(range(len(columns)), columns, rotation=25, ha="right", fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    figure.colorbar(image, ax=axes, label=heading)
    return _finish(figure, name, caption)


def bars(
    name: str,
    groups: Sequence[str],
    series: Mapping[str, Mapping[str, Estimate]],
    *,
    heading: str,
    caption: str,
) -> Figure:
    """Grouped bars with intervals: group -> one bar per series."""
    figure, axes = _figure(max(5.0, 1.5 + 0.9 * len(groups) * max(1, len(series)) ** 0.6), 3.6)
    width = 0.8 / max(1, len(series))
    for i, (label, values) in enumerate(series.items()):
        x = np.arange(len(groups)) + (i - (len(series) - 1) / 2) * width
        means = [values[g].mean if g in values else math.nan for g in groups]
        spans = [[_arm(values.get(g), side) for g in groups] for side in ("low", "high")]
        style = {"color": COLOURS[i % len(COLOURS)], "hatch": HATCHES[i % len(HATCHES)], "edgecolor": "white"}
        axes.bar(x, means, width, yerr=np.array(spans), capsize=2, label=label, ecolor="#333333", **style)
    axes.set_xticks(range(len(groups)), groups, rotation=20, ha="right", fontsize=8)
    axes.axhline(0, color="#333333", linewidth=0.8)
    axes.set_ylabel(heading)
    if len(series) > 1:
        axes.legend(fontsize=8)
    return _finish(figure, name, caption)


def _arm(estimate: Estimate | None, side: str) -> float:
    if estimate is None or math.isnan(estimate.low):
        return 0.0
    return estimate.mean - estimate.low if side == "low" else estimate.high - estimate.mean


def pareto(
    name: str,
    points: Sequence[tuple[str, str, float, float]],
    *,
    x_heading: str,
    y_heading: str,
    higher_is_better: bool,
    caption: str,
) -> Figure:
    """What is gained against what it costs, cost on a log axis; those that nobody beats in both are joined.

    Args:
        points: (series, label, cost above 0, value).
    """
    figure, axes = _figure(6.6, 4.4)
    for i, series in enumerate(dict.fromkeys(p[0] for p in points)):
        mine = [p for p in points if p[0] == series]
        style = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)]}
        axes.scatter([p[2] for p in mine], [p[3] for p in mine], s=36, label=series, zorder=3, **style)
    front = pareto_front([(p[2], p[3] if higher_is_better else -p[3]) for p in points])
    edge = sorted((points[i] for i in front), key=lambda p: p[2])
    axes.plot([p[2] for p in edge], [p[3] for p in edge], color="#777777", linewidth=1, linestyle="--", zorder=1)
    for _, label, x, y in edge:
        axes.annotate(label, (x, y), textcoords="offset points", xytext=(5, 5), fontsize=7)
    axes.set_xscale("log")
    axes.set_xlabel(f"{x_heading} (log scale)")
    axes.set_ylabel(y_heading)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return _finish(figure, name, caption)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Positions of the (cost, value) that no other beats in both: none is cheaper and at least as good, or as cheap
    and better.

    >>> pareto_front([(1, 1), (2, 3), (3, 2)])
    [0, 1]
    """
    return [
        i
        for i, (cost, value) in enumerate(points)
        if not any(c <= cost and v >= value and (c < cost or v > value) for c, v in points)
    ]


def curves(
    name: str, runs: Mapping[str, Sequence[Sequence[tuple[float, float]]]], *, x: str, y: str, caption: str
) -> Figure:
    """One thin line per training run, a thick one for the mean of a recipe over the steps that all its runs have."""
    figure, axes = _figure(6.6, 4.0)
    for i, (recipe, members) in enumerate(runs.items()):
        style = {"color": COLOURS[i % len(COLOURS)]}
        for run in members:
            axes.plot([p[0] for p in run], [p[1] for p in run], linewidth=0.8, alpha=0.45, **style)
        common = sorted(set.intersection(*({p[0] for p in run} for run in members)))
        means = [math.fsum(dict(run)[step] for run in members) / len(members) for step in common]
        label = f"{recipe} (mean of {len(members)} runs)" if len(members) > 1 else recipe
        axes.plot(common, means, linewidth=2, marker=MARKERS[i % len(MARKERS)], markersize=4, label=label, **style)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return _finish(figure, name, caption)


def routes(name: str, ways: Mapping[str, Sequence[tuple[float, float]]], *, caption: str) -> Figure:
    """Ways on one plane: a ring at the start, a square at the end, a dot at every step."""
    figure, axes = _figure(6.2, 5.2)
    for i, (label, points) in enumerate(ways.items()):
        x, y = [p[0] for p in points], [p[1] for p in points]
        style = {"color": COLOURS[i % len(COLOURS)]}
        axes.plot(x, y, linewidth=1.6, marker=".", markersize=4, linestyle=("-", "--")[i % 2], label=label, **style)
        axes.plot(x[:1], y[:1], marker="o", markersize=9, markerfacecolor="none", **style)
        axes.plot(x[-1:], y[-1:], marker="s", markersize=7, **style)
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return _finish(figure, name, caption)


def shares(
    name: str, groups: Sequence[str], parts: Mapping[str, Sequence[float]], *, heading: str, caption: str
) -> Figure:
    """Stacked horizontal bars: group -> shares (0 to 1) of each part; parts that are nowhere are left out."""
    figure, axes = _figure(8.6, 1.6 + 0.45 * len(groups))
    left = np.zeros(len(groups))
    shown = {part: np.array(values) for part, values in parts.items() if any(values)}
    for i, (part, values) in enumerate(shown.items()):
        style = {"color": COLOURS[i % len(COLOURS)], "hatch": HATCHES[(i // len(COLOURS)) * 3 + i % 3]}
        axes.barh(range(len(groups)), values, left=left, label=part, edgecolor="white", **style)
        left = left + values
    axes.set_yticks(range(len(groups)), groups, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(0, 1)
    axes.set_xlabel(heading)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return _finish(figure, name, caption)


def _figure(width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Drawing

    figure = Drawing(figsize=(max(4.0, width), max(2.4, height)), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots()


def _finish(figure: Any, name: str, caption: str) -> Figure:
    import matplotlib

    svg, png = io.StringIO(), io.BytesIO()
    # Text stays text (searchable, small), ids do not change from run to run.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(svg, format="svg", metadata={"Date": None})
    figure.savefig(png, format="png", dpi=130)
    return Figure(name, svg.getvalue(), png.getvalue(), caption)
