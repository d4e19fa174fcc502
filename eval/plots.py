"""Figures: the reward curve of a run and the heat map of a matrix.

Drawn with matplotlib's Agg canvas and without its global state, so that they can be made in any process and thread.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agentspec.files import write_atomic
from agentspec.metrics import Metric
from eval.tables import CellSummary, metrics_of


def reward_curve(
    rows: Sequence[Mapping[str, Any]],
    path: str | Path,
    *,
    key: str = "reward",
    window: int = 5,
    title: str = "",
    unit: str = "",
) -> bool:
    """Draw ``key`` over ``step`` from rows of a run's ``metrics.jsonl``, with its running mean over ``window`` rows.

    The band is one standard deviation of the rewards of a step (``reward_std``) where rows have it. ``unit`` says what
    the numbers are.

    Returns:
        Whether there was anything to draw; without rows that have ``key``, no file is written.
    """
    points = [r for r in rows if r.get(key) is not None and r.get("step") is not None]
    if not points:
        return False
    steps = np.array([float(r["step"]) for r in points])
    values = np.array([float(r[key]) for r in points])
    spread = np.array([float(r.get(f"{key}_std") or 0.0) for r in points])
    figure, axes = _figure(6.4, 4.0)
    if spread.any():
        band = "± one standard deviation of its episodes"
        axes.fill_between(steps, values - spread, values + spread, alpha=0.15, linewidth=0, label=band)
    axes.plot(steps, values, marker=".", linewidth=0.8, alpha=0.6, label="mean of the update's episodes")
    if len(points) >= window > 1:
        axes.plot(steps, running_mean(values, window), linewidth=2, label=f"mean over {window} updates")
    axes.legend(fontsize=8)
    _label(axes, key, title, unit)
    _save(figure, path)
    return True


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Mean of the last ``window`` values (of fewer at the start); same length as ``values``."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    result: np.ndarray = (sums[ends] - sums[starts]) / (ends - starts)
    return result


def matrix_heatmap(cells: Sequence[CellSummary], path: str | Path, *, metric: str = "") -> bool:
    """Draw policy x scaffold, one panel per set of tasks; every field shows its mean and interval.

    Args:
        metric: name of one of the cells' metrics; default: their primary one.

    Returns:
        Whether there was anything to draw.

    Raises:
        ValueError: an unknown metric.
    """
    known = {m.name: m for m in metrics_of(cells)}
    if metric and known and metric not in known:
        raise ValueError(f"unknown metric {metric!r}; known: {', '.join(known)}")
    drawn = known.get(metric) or next(iter(known.values()), None)
    shown = [c for c in cells if drawn and drawn.name in c.estimates]
    if not shown or drawn is None:
        return False
    tasks = list(dict.fromkeys(c.tasks for c in shown))
    policies, scaffolds = ([*dict.fromkeys(getattr(c, k) for c in shown)] for k in ("policy", "scaffold"))
    figure, panels = _figure(len(tasks) * (2 + 1.5 * len(scaffolds)), 1.6 + 0.8 * len(policies), len(tasks))
    for axes, label in zip(np.atleast_1d(panels), tasks, strict=True):
        _panel(figure, axes, [c for c in shown if c.tasks == label], policies, scaffolds, drawn)
        axes.set_title(f"{label}: {drawn.heading}")
    _save(figure, path)
    return True


def _panel(
    figure: Any, axes: Any, cells: Sequence[CellSummary], policies: list[str], scaffolds: list[str], metric: Metric
) -> None:
    grid = np.full((len(policies), len(scaffolds)), np.nan)
    for c in cells:
        grid[policies.index(c.policy), scaffolds.index(c.scaffold)] = c.estimates[metric.name].mean
    image = axes.imshow(grid, cmap="viridis" if metric.higher_is_better else "viridis_r", aspect="auto")
    for c in cells:
        e = c.estimates[metric.name]
        text = f"{e.mean:.2f}" + ("" if math.isnan(e.low) else f"\n[{e.low:.2f}, {e.high:.2f}]")
        at = (scaffolds.index(c.scaffold), policies.index(c.policy))
        red, green, blue, _ = image.cmap(image.norm(e.mean))
        dark = 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
        axes.text(*at, text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
    axes.set_xticks(range(len(scaffolds)), scaffolds, rotation=20, ha="right")
    axes.set_yticks(range(len(policies)), policies)
    figure.colorbar(image, ax=axes)


def _label(axes: Any, key: str, title: str, unit: str) -> None:
    axes.set_xlabel("update (optimiser step)")
    axes.set_ylabel(f"{key} per episode{f' ({unit})' if unit else ''}, mean")
    axes.set_title(title or f"{key} while training: sampled episodes on training tasks")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(alpha=0.3)


def _figure(width: float, height: float, columns: int = 1) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(4.0, width), max(2.5, height)), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, columns)


def _save(figure: Any, path: str | Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format=Path(path).suffix.lstrip(".") or "png", dpi=120)
    write_atomic(path, buffer.getvalue())
