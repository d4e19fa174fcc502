"""The table of what memories cost, the paper's ratios beside it, and why ours differ where they do.

A ratio is tokens per step relative to `base`. Ours splits exactly into the prompts (or answers) of decisions and those
of memory's own calls, purpose by purpose, so what the sentence under the table says of a method is computed from its
own calls: whether its own calls or its decisions put it outside the paper's range, how many more calls of its size
would bring it there, and what its preset cuts.
"""

from __future__ import annotations

import csv
import statistics
import sys
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from agentspec.registry import REGISTRY, SpecError

PAPER = Path(__file__).resolve().parents[2] / "shared" / "paper" / "results.csv"
BASELINE = "base"
RATIOS = {"input_tokens_per_step": ("in", "read"), "output_tokens_per_step": ("out", "write")}
"""Figure -> its direction, and the verb that goes with it."""

NAMES = ("method", "preset", "calls", "of memory", "tokens in", "cached", "tokens out", "retrieval ms")
NAMES += ("bytes half way", "at the end", "malformed", "in / base", "paper", "out / base", "paper")


class Told(NamedTuple):
    """What the paper's agents spent with a memory: relative to base over its backbones, and median tokens per step."""

    ratio: float
    least: float
    most: float
    base: float
    spent: float


def paper_ratios(path: Path = PAPER) -> dict[str, dict[str, Told]]:
    """Memory -> figure -> what the paper tells. Empty where the paper's numbers are not there."""
    if not path.is_file():
        return {}
    values: dict[tuple[str, str, str, str], float] = {}
    with open(path, encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            plain = row["reasoning"] == "react" and row["reflection"] in ("", "none") and row["policy"] == "non_rl"
            if plain and row["environment"] == "deliverybench" and row["metric"] in RATIOS:
                values[row["table"], row["backbone"], row["memory"], row["metric"]] = float(row["value"])
    found: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for (table, backbone, memory, metric), value in values.items():
        base = values.get((table, backbone, BASELINE, metric))
        if base and memory != BASELINE:
            found[memory][metric].append((base, value))
    return {
        memory: {metric: _told(pairs) for metric, pairs in by_metric.items()} for memory, by_metric in found.items()
    }


def _told(pairs: list[tuple[float, float]]) -> Told:
    ratios = [spent / base for base, spent in pairs]
    bases, spents = zip(*pairs, strict=True)
    return Told(
        statistics.median(ratios), min(ratios), max(ratios), statistics.median(bases), statistics.median(spents)
    )


def markdown(
    rows: Mapping[str, Mapping[str, Any]], paper: Mapping[str, Mapping[str, Told]], about: Mapping[str, Any]
) -> str:
    """The table, what each memory asks, and why ratios lie outside the paper's range."""
    base = rows.get(BASELINE, {})
    weights = " in ".join(filter(None, (about["model"], about.get("dtype"))))
    lines = [
        "# What memories cost",
        "",
        f"{about['steps']} steps of DeliveryBench, ReAct, {weights}, snapshot layout, preset",
        f"`{about['preset']}`; per step unless it says otherwise. *paper*: tokens per step relative to ReAct + Base,",
        "median over its backbones (least to most).",
        "",
        f"    {about['command']}",
        "",
        "| " + " | ".join(NAMES) + " |",
        "|" + "---|" * len(NAMES),
    ]
    differences: list[str] = []
    for name, row in rows.items():
        if "failed" in row:
            lines.append(f"| {name} | failed: {row['failed']} |" + " |" * (len(NAMES) - 2))
            continue
        lines.append("| " + " | ".join(_cells(name, row, base, paper.get(name, {}))) + " |")
        for metric, told in paper.get(name, {}).items():
            if base.get(metric) and not told.least <= row[metric] / base[metric] <= told.most:
                differences.append(difference(name, metric, row, base, told))
    lines += ["", "## What they ask", "", *_asked(rows), "", "## Where ours differ from the paper", ""]
    return "\n".join([*lines, *(differences or ["No ratio lies outside the paper's range."])]) + "\n"


def _cells(name: str, row: Mapping[str, Any], base: Mapping[str, Any], told: Mapping[str, Told]) -> list[str]:
    cells = [name, row.get("preset", "")]
    cells += [f"{row[k]:.2f}" for k in ("calls_per_step", "memory_calls_per_step")]
    cells += [f"{row[f'{k}_tokens_per_step']:.0f}" for k in ("input", "cached", "output")]
    cells += [f"{row['retrieve_ms']:.2f}", str(row["bytes_half_way"]), str(row["bytes_at_end"])]
    cells.append(f"{100 * row['malformed_share']:.0f} %" if row["memory_calls_per_step"] else "")
    for metric in RATIOS:
        cells.append(f"{row[metric] / base[metric]:.2f}" if base.get(metric) else "")
        known = told.get(metric)
        cells.append(f"{known.ratio:.2f} ({known.least:.2f} to {known.most:.2f})" if known else "")
    return cells


def _asked(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Calls of each purpose: how often, and how long prompts and answers are."""
    lines = ["| method | call | per step | tokens in | tokens out |", "|---|---|---|---|---|"]
    for name, row in rows.items():
        for purpose, call in {"(decision)": row["decision"], **row["purposes"]}.items() if "failed" not in row else ():
            figures = f"{call['calls_per_step']:.2f} | {call['input_tokens']:.0f} | {call['output_tokens']:.0f}"
            lines.append(f"| {name} | {purpose} | {figures} |")
    return lines


def difference(name: str, metric: str, row: Mapping[str, Any], base: Mapping[str, Any], told: Told) -> str:
    """Why a ratio lies outside the paper's range, from the method's calls."""
    direction, verb = RATIOS[metric]
    kind = "input_tokens" if direction == "in" else "output_tokens"
    ours, at_base = row[metric], base[metric]
    own = {p: c["calls_per_step"] * c[kind] for p, c in row["purposes"].items()}
    decided = row["decision"]["calls_per_step"] * row["decision"][kind]
    side = "more" if ours / at_base > told.most else "less"
    told_range = f"{told.least:.2f} to {told.most:.2f}"
    head = f"- `{name}`, tokens {direction}: {ours / at_base:.2f} of base, {side} than the paper's {told_range}."
    where = f"Decisions {verb} {decided:.0f} tokens a step (with base {at_base:.0f}), {_own_calls(row, kind)}."
    why = _too_many if side == "more" else _too_few
    parts = [head, where, why(verb, decided, sum(own.values()), at_base, told, row), _lost(row)]
    if side == "less":
        parts.append(_cuts(name, row.get("preset", "")))
    return " ".join(filter(None, parts))


def _own_calls(row: Mapping[str, Any], kind: str) -> str:
    calls = [
        f"`{p}` {c['calls_per_step']:.2f} a step of {c[kind]:.0f}"
        for p, c in row["purposes"].items()
        if c["calls_per_step"]
    ]
    total = sum(c["calls_per_step"] * c[kind] for c in row["purposes"].values())
    return f"memory's own calls {total:.0f}: {', '.join(calls)}" if calls else "memory asks the model nothing"


def _too_many(verb: str, decided: float, own: float, base: float, told: Told, row: Mapping[str, Any]) -> str:
    """Above the range: by its own calls, or because decisions are not as much cheaper as the paper's."""
    if decided <= told.most * base:
        return f"Its own calls put it above: without them it would be {decided / base:.2f}."
    paper = f"base {verb}s {told.base:.0f} tokens a step and {told.spent:.0f} with this memory"
    if told.spent < told.base:
        saved = (
            f"there memory takes the place of {told.base - told.spent:.0f} tokens, more than our base {verb}s at all"
        )
        return f"In the paper {paper}: {saved}." if told.base - told.spent > base else f"In the paper {paper}."
    return f"Decisions alone are at {decided / base:.2f}; in the paper {paper}."


def _too_few(verb: str, decided: float, own: float, base: float, told: Told, row: Mapping[str, Any]) -> str:
    """Below the range: how many more calls of its size would bring it there."""
    missing = told.least * base - decided - own
    calls = row["memory_calls_per_step"]
    paper = f"In the paper base {verb}s {told.base:.0f} tokens a step and {told.spent:.0f} with this memory"
    if not calls:
        return f"{paper}; {missing:.0f} tokens a step are missing here."
    more = missing / (own / calls) if own else 0.0
    return f"{paper}; {missing:.0f} are missing here: {more:.2f} more calls a step of this size (it makes {calls:.2f})."


def _lost(row: Mapping[str, Any]) -> str:
    share = row["malformed_share"]
    return (
        f"{100 * share:.0f} % of its answers could not be used, so what they would have written is not recalled."
        if share
        else ""
    )


def _cuts(name: str, preset: str) -> str:
    """What the preset cuts, beside preset `paper`."""
    try:
        cls = REGISTRY.get("memory", name).load()
    except SpecError:
        return ""
    presets = getattr(sys.modules[cls.__module__], "PRESETS", {})
    full, chosen = presets.get("paper", {}), presets.get(preset, {})
    cut = [f"`{k}` {v} (`paper`: {full[k]})" for k, v in chosen.items() if k in full and full[k] != v]
    return f"Preset `{preset}` sets {', '.join(cut)}." if cut else ""
