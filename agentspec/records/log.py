"""The records of a run as they are written: manifest, episodes, receipts, logs, seal."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agentspec.files import (
    append_lines,
    digest,
    file_digest,
    jsonable,
    last_line,
    parse_line,
    read_lines,
    whole_lines,
    write_atomic,
)
from agentspec.records.chain import seal_of
from agentspec.records.digests import field_digests
from agentspec.records.folder import (
    EVALUATIONS,
    FORMAT,
    MANIFEST,
    MANIFESTS,
    MEMORY,
    METRICS,
    SEAL,
    STATE,
    TRAJECTORIES,
    UPDATES,
    checkpoints,
    digest_of,
    round_files,
)
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, versions


class RunLog:
    """Writes into a run's folder; nothing is ever half written."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._written: dict[str, dict[str, Any]] = {}

    def manifest(self, **fields: Any) -> None:
        """Write `manifest.json`: what was run, with which versions and command. One that is there is kept beside it."""
        given = {"format": FORMAT, "command": sys.argv, "versions": versions(), "previous": self._keep_manifest()}
        data = given | jsonable(fields)
        data["digests"] = field_digests(data)
        write_atomic(self.folder / MANIFEST, json.dumps(data, indent=2, sort_keys=True) + "\n")

    def _keep_manifest(self) -> str:
        """Put the present manifest among the earlier ones; the digest of the newest of them, empty if there is none."""
        kept = sorted((self.folder / MANIFESTS).glob("*.json"))
        newest = file_digest(kept[-1]) if kept else ""
        found = digest_of(self.folder / MANIFEST)
        if found in ("", newest):
            return newest
        write_atomic(self.folder / MANIFESTS / f"{len(kept):06d}.json", (self.folder / MANIFEST).read_bytes())
        return found

    def trajectories(self, round: int, rank: int, episodes: Sequence[Trajectory], kind: str = TRAJECTORIES) -> None:
        """Write this rank's episodes of one generation round into the run's folder `kind`."""
        name = f"{kind}/{round:06d}.jsonl" if rank == 0 else f"{kind}/{round:06d}.rank{rank}.jsonl"
        lines = [episode.to_json() for episode in episodes]
        blob = "".join(line + "\n" for line in lines)
        write_atomic(self.folder / name, blob)
        self._written[name] = {"digest": digest(blob), "episodes": [field_digests(json.loads(line)) for line in lines]}

    def written(self) -> dict[str, dict[str, Any]]:
        """File -> its `digest` and that of each of its `episodes` by field, since this was last asked."""
        written, self._written = self._written, {}
        return written

    @property
    def sealed(self) -> bool:
        """Whether the run has ended."""
        return (self.folder / SEAL).is_file()

    def append(self, name: str, record: Mapping[str, Any]) -> None:
        """Append one JSON line to `name`; `SpecError` if the run has ended."""
        if self.sealed:
            raise SpecError(f"{self.folder} is sealed ({SEAL}): its run has ended, and nothing is added to its records")
        append_lines(self.folder / name, record)

    def receipt(self, record: Mapping[str, Any], files: Mapping[str, Any], memory: bytes | None = None) -> None:
        """Append a receipt, chained to the one before it, the manifest and its round's files (as of `written`).

        Args:
            memory: what the next round starts from, kept as `memory.json`; `None`: nothing is carried.
        """
        last = last_line(self.folder / UPDATES)
        chain = {"manifest": digest_of(self.folder / MANIFEST), "files": dict(files)}
        chain["previous"] = digest(last) if last else ""
        if memory is not None:
            chain["memory"] = digest(memory)
        self.append(UPDATES, {**record, "chain": chain})
        if memory is not None:
            write_atomic(self.folder / MEMORY, memory)

    def seal(self) -> str:
        """End the chain; returns its head, the digest of the seal."""
        blob = seal_of(self.folder)
        write_atomic(self.folder / SEAL, blob)
        return digest(blob)

    def read(self, name: str) -> list[dict[str, Any]]:
        """All whole records of a JSONL file of this run (none if it does not exist); the file stays as it is."""
        return read_lines(self.folder / name)

    def rewind(self, name: str, key: str, last: int) -> None:
        """Drop records whose `key` exceeds `last`: a resumed run writes them again. The others stay to the byte."""
        path = self.folder / name
        lines = [(parse_line(path, number, line), line) for number, line in whole_lines(path)]
        kept = [line for record, line in lines if record.get(key, 0) <= last]
        if len(kept) < len(lines):
            write_atomic(path, b"".join(kept))

    def rewind_to(self, step: int, memory: bytes | None = None) -> None:
        """The run goes on from checkpoint `step`, with its `memory`: drop what it holds beyond, and its seal."""
        (self.folder / SEAL).unlink(missing_ok=True)
        self.rewind(METRICS, "step", step)
        self.rewind(UPDATES, "round", step - 1)
        self.rewind(EVALUATIONS, "step", step)
        if memory is not None:
            write_atomic(self.folder / MEMORY, memory)
        for path in round_files(self.folder):
            if int(path.name[:6]) >= step:
                path.unlink()
        for path in checkpoints(self.folder):
            if int(path.name.rpartition("-")[2]) > step:
                (path / STATE).unlink()  # without its records nobody may go on from it
