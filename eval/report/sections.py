"""Sections of a report that need more than rows: training logs, kept trajectories, the paper's numbers."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from agentspec.failures import LEAVES
from agentspec.files import read_lines
from agentspec.metrics import primary_metric
from agentspec.records.folder import METRICS
from agentspec.trajectory import read_trajectories
from eval import paper
from eval.failures import OPEN, Diagnosis, Shares, by_scaffold, diagnose, paper_shares
from eval.report import figures
from eval.report.blocks import Block, Heading, Table, Text
from eval.tables import show, summarise

Row = Mapping[str, Any]
WORLDS = {
    "agentspec/DeliveryBench": "deliverybench",
    "agentspec/MiniGrid": "minigrid",
    "agentspec/Alfred": "alfred",
    "agentspec/RoboThor": "robothor",
}


def learning_section(runs: Mapping[str, Sequence[str | Path]], *, key: str = "reward") -> list[Block]:
    """Reward over optimiser steps, from the logs of training runs.

    Raises:
        ValueError: a folder without a training log.
    """
    if not runs:
        return []
    curves: dict[str, list[list[tuple[float, float]]]] = {}
    for recipe, folders in runs.items():
        for folder in folders:
            path = Path(folder) / METRICS if Path(folder).is_dir() else Path(folder)
            if not path.is_file():
                raise ValueError(f"{folder} has no {METRICS}; give the folder of a training run")
            points = [(row["step"], row[key]) for row in read_lines(path) if row.get(key) is not None and "step" in row]
            if points:
                curves.setdefault(recipe, []).append(points)
    counted = ", ".join(f"{recipe}: {len(members)}" for recipe, members in curves.items())
    caption = f"Mean {key} of the rollouts of each update, as trained on (sampled, training tasks). Runs: {counted}."
    return [Heading("Learning curves"), figures.curves("learning", curves, x="update", y=key, caption=caption)]


def failures_section(rows: Sequence[Row], folder: Path, *, paper: bool) -> list[Block]:
    """Kinds of failure per world and scaffold, where trajectories were kept."""
    kept = [row for row in rows if row.get("trajectory") and (folder / row["trajectory"]).is_file()]
    if not kept:
        return []
    shares = by_scaffold(_diagnosed(kept, folder))
    worlds = dict.fromkeys(world for world, _ in shares)
    printed = {world: found for world in worlds if (found := paper_shares(world))} if paper else {}
    present = [
        leaf
        for leaf in (*LEAVES, OPEN)
        if any(s.leaves[leaf] for s in shares.values()) or any(found.get(leaf) for found in printed.values())
    ]
    blocks: list[Block] = [Heading("Failures")]
    if not any(s.failed for s in shares.values()):
        return [*blocks, Text(f"None of {len(kept)} episodes failed.")]
    named = [(f"{world} / {scaffold}", s) for (world, scaffold), s in shares.items() if s.failed]
    groups = {name: _parts(s, present) for name, s in named}
    for world, found in printed.items():
        groups[f"{world}: the paper's agents"] = [found.get(leaf, 0.0) for leaf in present]
    parts = {leaf: [values[i] for values in groups.values()] for i, leaf in enumerate(present)}
    body = [
        [name, str(s.episodes), str(s.failed), *(f"{s.share(leaf):.0%}" if s.leaves[leaf] else "–" for leaf in present)]
        for name, s in named
    ]
    caption = (
        "Share of failures that each kind leads, by rules on the trajectory, all policies together; `open`: no rule "
        "explains it. "
        f"n = {sum(s.failed for s in shares.values())} failures of {sum(s.episodes for s in shares.values())} episodes."
    )
    drawing = figures.shares("failures", list(groups), parts, heading="share of failures", caption=caption)
    short = [leaf.split("/", 1)[-1] for leaf in present]
    return [*blocks, drawing, Table(["world / scaffold", "episodes", "failed", *short], body, caption)]


def _parts(shares: Shares, leaves: Sequence[str]) -> list[float]:
    return [shares.share(leaf) for leaf in leaves]


def _diagnosed(rows: Sequence[Row], folder: Path) -> Iterator[tuple[str, str, Diagnosis]]:
    for row in rows:
        if row["status"] != "completed":
            continue
        [trajectory] = read_trajectories(folder / row["trajectory"])
        yield world_of(row), str(row["scaffold"]), diagnose(trajectory)


def world_of(row: Row) -> str:
    """The paper's name of a row's world, or the environment's own id."""
    env = str(row.get("env", ""))
    return next((name for prefix, name in WORLDS.items() if env.startswith(prefix) or env == name), env)


def paper_section(rows: Sequence[Row]) -> list[Block]:
    """The paper's numbers for the same worlds and modules, in a table of their own."""
    blocks: list[Block] = [Heading("Beside the paper")]
    for world in dict.fromkeys(map(world_of, rows)):
        members = [row for row in rows if world_of(row) == world]
        body = _beside(world, members)
        if body:
            metric = primary_metric(members)
            caption = (
                f"{world}: ours ({metric.heading}) with its interval; the paper's: lowest, median and highest over its "
                "backbones, means of three runs at most, without a spread. Models, cities and step limits differ: the "
                "columns are set side by side, not compared."
            )
            blocks.append(Table(["policy", "modules", "ours", "paper: low", "median", "high"], body, caption))
    return blocks if len(blocks) > 1 else []


def _beside(world: str, rows: Sequence[Row]) -> list[list[str]]:
    wanted = paper.metric_of(world)
    metric = primary_metric(rows)
    agents = {(row["policy"], row["scaffold"]): row["agent"] for row in rows if row.get("agent")}
    body = []
    for cell in summarise(rows):
        agent = agents.get((cell.policy, cell.scaffold), {})  # a scripted policy's is none of the paper's
        modules = tuple(agent.get(kind, "") for kind in ("reasoning", "memory", "reflection"))
        printed = sorted(
            n.value
            for n in paper.numbers()
            if n.environment == world and n.metric == wanted and n.scaffold == modules and n.policy == "non_rl"
        )
        if printed and metric.name in cell.estimates:
            low, median, high = printed[0], statistics.median(printed), printed[-1]
            ours = show(cell.estimates[metric.name], metric.digits)
            numbers = [f"{value:.2f}" for value in (low, median, high)]
            body.append([cell.policy, " + ".join(m for m in modules if m != "none"), ours, *numbers])
    return body
