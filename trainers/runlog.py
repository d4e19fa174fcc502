"""What a run leaves behind: a manifest, every trajectory, and a receipt of every update.

::

    runs/quickstart/
        manifest.json             config, spec, versions, command
        trajectories/000001.jsonl one file per generation round
        updates.jsonl             one receipt per generation round: rows, tokens, denominators, advantages
        metrics.jsonl             what the trainer logged
        evaluations.jsonl         what evaluation while training found (eval_strategy: steps)
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agentspec.state import write_atomic
from agentspec.trajectory import Trajectory, jsonable, versions, write_trajectories


class RunLog:
    """Writes into a run's folder; nothing is ever half written."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def manifest(self, **fields: Any) -> None:
        """Write ``manifest.json``: what was run, with which versions and command."""
        data = {"command": sys.argv, "versions": versions(), **jsonable(fields)}
        write_atomic(self.folder / "manifest.json", json.dumps(data, indent=2, sort_keys=True) + "\n")

    def trajectories(self, round: int, rank: int, trajectories: Sequence[Trajectory]) -> None:
        """Write this rank's episodes of one generation round."""
        name = f"{round:06d}.jsonl" if rank == 0 else f"{round:06d}.rank{rank}.jsonl"
        write_trajectories(self.folder / "trajectories" / name, trajectories)

    def append(self, name: str, record: Mapping[str, Any]) -> None:
        """Append one JSON line to ``name``; a line that a crash cut short is dropped first."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        drop_partial_line(path)
        with open(path, "a", encoding="utf-8") as file:
            file.write(json.dumps(jsonable(record), sort_keys=True) + "\n")

    def read(self, name: str) -> list[dict[str, Any]]:
        """All whole records of a JSONL file of this run (none if it does not exist); the file stays as it is.

        Raises:
            ValueError: naming file and line of what is not JSON.
        """
        path = self.folder / name
        if not path.is_file():
            return []
        whole, _, _ = path.read_text(encoding="utf-8").rpartition("\n")
        records = []
        for number, line in enumerate(whole.split("\n"), 1):
            if line.strip():
                try:
                    records.append(json.loads(line))
                except ValueError as error:
                    raise ValueError(f"{path}, line {number}: not JSON ({error}); the file was damaged") from error
        return records

    def rewind(self, name: str, key: str, last: int) -> None:
        """Drop records whose ``key`` exceeds ``last``: a resumed run writes them again."""
        records = self.read(name)
        kept = [r for r in records if r.get(key, 0) <= last]
        if len(kept) < len(records):
            write_atomic(self.folder / name, "".join(json.dumps(r, sort_keys=True) + "\n" for r in kept))


def drop_partial_line(path: Path) -> None:
    """Cut a last line without newline: the only damage an interrupted append can do."""
    if not path.is_file() or path.stat().st_size == 0:
        return
    data = path.read_bytes()
    if not data.endswith(b"\n"):
        write_atomic(path, data[: data.rfind(b"\n") + 1])


def paths_called(trajectories: Sequence[Trajectory]) -> set[str]:
    """``module/purpose (credit)`` of everything that the episodes asked the model."""
    return {f"{c.tag.path} ({p.credit})" for t in trajectories for c in t.calls for p in c.completions}


def transcript(trajectory: Trajectory) -> str:
    """What the agent did, for TRL's completion logs."""
    if not trajectory.scorable:
        return f"[failed] {trajectory.error}"
    return "\n".join(t.action_text for t in trajectory.transitions)
