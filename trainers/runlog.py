"""What a run leaves behind, each file a link of one chain.

    runs/quickstart/
        manifest.json             config, spec, versions, command
        manifests/000000.json     those before it: a resumed run has a new one, which names the digest of the one before
        trajectories/000001.jsonl one file per generation round
        updates.jsonl             one receipt per generation round (`trainers.receipts`)
        memory.json               with `scope: run`: the memories that tasks carry on (`agentspec.carry`)
        metrics.jsonl             what the trainer logged
        evaluations.jsonl         what evaluation while training found (`eval_strategy: steps`)
        seal.json                 written when the run ends: its digest is the head of the chain

A receipt holds the digests of its round's trajectory files, of the memory after it, of the manifest and of the receipt
before it; the seal those of all these files, and of each of their lines. Whoever keeps the head can tell any later
edit. Without it, an edit is told as long as its author does not compute every digest after it anew.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agentspec.carry import FILE as MEMORY
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
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, versions
from trainers import run_folder
from trainers.digests import field_digests
from trainers.run_folder import EVALUATIONS, MANIFEST, MANIFESTS, METRICS, SEAL, TRAJECTORIES, UPDATES

FORMAT = 4
SEALED = (MANIFEST, UPDATES, MEMORY, METRICS, EVALUATIONS)


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
        """Append one JSON line to `name`.

        Raises:
            SpecError: the run has ended.
        """
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
        """All whole records of a JSONL file of this run (none if it does not exist); the file stays as it is.

        Raises:
            ValueError: naming file and line of what is not JSON.
        """
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
        for path in run_folder.checkpoints(self.folder):
            if int(path.name.rpartition("-")[2]) > step:
                (path / run_folder.STATE).unlink()  # without its records nobody may go on from it


def round_files(folder: Path) -> list[Path]:
    """The trajectory files of all rounds, in `trajectories` and in every other folder of the run that has some."""
    return sorted(p for p in folder.glob("*/[0-9][0-9][0-9][0-9][0-9][0-9]*.jsonl") if p.is_file())


def digest_of(path: Path) -> str:
    """Digest of a file; empty if there is none."""
    return file_digest(path) if path.is_file() else ""


def seal_of(folder: Path) -> str:
    """The seal of a folder as it is: of every record its digest and, of a file of lines, 16 digits of each line's."""
    files = {}
    for path in (folder / name for name in SEALED if (folder / name).is_file()):
        lines = [digest(line)[:16] for _, line in whole_lines(path)] if path.suffix == ".jsonl" else []
        files[path.name] = {"digest": file_digest(path), "lines": lines}
    return json.dumps({"format": FORMAT, "files": files}, indent=1, sort_keys=True) + "\n"
