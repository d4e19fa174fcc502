"""What the training runs of a study did and took: kinds of call, tokens and CPU hours, audits.

`study.json` beside the results says which runs there are (`recipes/learning_study.py` writes it), each run's
`metrics.jsonl` what it logged.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agentspec.files import read_lines
from agentspec.records.folder import METRICS, UPDATES
from eval.report.blocks import Block, Heading, Table, Text

Row = Mapping[str, Any]
FILE = "study.json"
COSTS = "costs.jsonl"


def read_study(folder: Path) -> dict[str, Any]:
    """What a study says of itself; nothing where there is none."""
    path = folder / FILE
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def study_runs(folder: Path) -> dict[str, list[Path]]:
    """Arm -> folders of its training runs that have logged something, of the study in `folder`."""
    arms = read_study(folder).get("arms", {})
    found = {arm: [folder / run for run in item["runs"].values() if _log(folder / run)] for arm, item in arms.items()}
    return {arm: folders for arm, folders in found.items() if folders}


def trained(study: Mapping[str, Any], folder: Path) -> list[Block]:
    """Towards what each kind of call was trained: from what the runs logged."""
    body = []
    for arm, item in study["arms"].items():
        logs = [log for run in item["runs"].values() if (log := _log(folder / run))]
        paths = {key[len("calls/") : -len("/tokens")] for log in logs for row in log for key in row if _counts(key)}
        for path in sorted(paths):
            body.append([arm, path, *_of_path(logs, path)])
    if not body:
        return []
    header = ["trained", "call", "runs", "tokens/update", "advantage mass", "entropy first", "last", "truncated"]
    caption = (
        "Trained tokens by kind of call, means over the updates of all runs; advantage mass: share of the sum of "
        "absolute advantages that fell on them; entropy (nats) in the first and in the last update; truncated: share "
        "of answers that hit their length limit. From each run's `metrics.jsonl`."
    )
    return [Heading("What was trained", 3), Table(header, body, caption)]


def _counts(key: str) -> bool:
    return key.startswith("calls/") and key.endswith("/tokens")


def _log(folder: Path) -> list[dict[str, Any]]:
    return _lines(folder / METRICS)


def _lines(path: Path) -> list[dict[str, Any]]:
    return read_lines(path) if path.is_file() else []


def _of_path(logs: Sequence[Sequence[Row]], path: str) -> list[str]:
    def mean(name: str, rows: Sequence[Row], digits: int) -> str:
        values = [row[f"calls/{path}/{name}"] for row in rows if row.get(f"calls/{path}/{name}") is not None]
        return f"{math.fsum(values) / len(values):.{digits}f}" if values else "–"

    everything = [row for log in logs for row in log]
    ends = ([log[place] for log in logs] for place in (0, -1))
    return [
        str(len(logs)),
        mean("tokens", everything, 0),
        mean("advantage_mass", everything, 2),
        *(mean("entropy", rows, 3) for rows in ends),
        mean("truncated", everything, 2),
    ]


def taken(rows: Sequence[Row], study: Mapping[str, Any], folder: Path) -> list[Block]:
    """Tokens and CPU hours of all there was to do."""
    hours: dict[str, float] = {}
    for line in _lines(folder / COSTS):
        hours[line["what"]] = hours.get(line["what"], 0.0) + line["cpu_s"] / 3600
    played: dict[str, tuple[int, float, float]] = {}
    for arm, item in study["arms"].items():
        for run in item["runs"].values():
            log, n = _log(folder / run), item["rollouts"] * len(_lines(folder / run / UPDATES))  # one receipt a round
            read, wrote = (n * _mean(log, f"episode/{name}_tokens") for name in ("input", "output"))
            before = played.get(f"train {arm}", (0, 0.0, 0.0))
            played[f"train {arm}"] = (before[0] + n, before[1] + read, before[2] + wrote)
    model = [r for r in rows if r["status"] == "completed" and r.get("input_tokens")]
    sums = [float(sum(r.get(name) or 0 for r in model)) for name in ("input_tokens", "output_tokens")]
    played["evaluation"] = (len(model), sums[0], sums[1])
    what = list(dict.fromkeys([*hours, *played]))
    body = [[w, *(f"{v:,.0f}" for v in played[w])] if w in played else [w, "–", "–", "–"] for w in what]
    body = [[*line, f"{hours[w]:.2f}" if w in hours else "–"] for line, w in zip(body, what, strict=True)]
    totals = [sum(p[i] for p in played.values()) for i in range(3)]
    body.append(["in all", *(f"{v:,.0f}" for v in totals), f"{math.fsum(hours.values()):.2f}"])
    caption = (
        "Episodes of a model, tokens of its calls (prompts as they were sent, whether or not a part was cached), and "
        "CPU hours of the processes that came to an end (`costs.jsonl`); what a killed process took is not counted. "
        "Evaluation: episodes in this matrix, scripted policies left out."
    )
    header = ["what", "episodes", "tokens in", "tokens out", "CPU hours"]
    return [Heading("What it took", 3), Table(header, body, caption)]


def _mean(rows: Sequence[Row], name: str) -> float:
    """Of the rows that have a number of this name; 0 where none has."""
    values = [row[name] for row in rows if row.get(name) is not None]
    return math.fsum(values) / len(values) if values else 0.0


def audits(study: Mapping[str, Any]) -> list[Block]:
    found = study.get("audits") or {}
    if not found:
        return []
    body = [
        [run, str(a["updates"]), str(len(a["violations"])), "; ".join(a["notes"]) or "–", a["head"][:16] or "–"]
        for run, a in found.items()
    ]
    wrong = [f"{run}: {a['violations'][0]}" for run, a in found.items() if a["violations"]]
    caption = "`agentspec audit` of every training run: receipts made anew from the episodes; head of each run's chain."
    blocks: list[Block] = [
        Heading("Audit receipts", 3),
        Table(["run", "updates", "violations", "notes", "head"], body, caption),
    ]
    return [*blocks, *([Text(f"First violations: {'; '.join(wrong)}.")] if wrong else [])]
