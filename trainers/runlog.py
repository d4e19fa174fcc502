"""What a run leaves behind, each file a link of one chain.

    runs/quickstart/
        manifest.json             config, spec, versions, command
        manifests/000000.json     those before it: a resumed run has a new one, which names the digest of the one before
        trajectories/000001.jsonl one file per generation round
        updates.jsonl             one receipt per generation round (`trainers.receipts`)
        metrics.jsonl             what the trainer logged
        evaluations.jsonl         what evaluation while training found (`eval_strategy: steps`)
        seal.json                 written when the run ends: its digest is the head of the chain

A receipt holds the digests of its round's trajectory files, of the manifest and of the receipt before it; the seal
holds those of the last receipt and of all logged lines, and how many bytes these files have. Whoever keeps the head can
tell any later edit. Without it, an edit is told as long as its author does not compute every digest after it anew.
"""

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
from agentspec.trajectory import Trajectory, versions
from trainers.digests import field_digests
from trainers.run_folder import EVALUATIONS, MANIFEST, MANIFESTS, METRICS, SEAL, TRAJECTORIES, UPDATES

FORMAT = 3
LOGGED = (METRICS, EVALUATIONS)
"""Files that the seal covers line by line."""


class RunLog:
    """Writes into a run's folder; nothing is ever half written."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._written: dict[str, dict[str, Any]] = {}

    def manifest(self, **fields: Any) -> None:
        """Write `manifest.json`: what was run, with which versions and command. One that is there is kept beside it."""
        previous = self._keep_manifest()
        data = {
            "format": FORMAT,
            "command": sys.argv,
            "versions": versions(),
            "previous": previous,
            **jsonable(fields),
        }
        data["digests"] = field_digests(data)
        write_atomic(self.folder / MANIFEST, json.dumps(data, indent=2, sort_keys=True) + "\n")

    def _keep_manifest(self) -> str:
        """Put the present manifest among the earlier ones; the digest of the newest of them, empty if there is none."""
        kept = sorted((self.folder / MANIFESTS).glob("*.json"))
        newest = file_digest(kept[-1]) if kept else ""
        present = self.folder / MANIFEST
        if present.is_file() and (found := file_digest(present)) != newest:
            write_atomic(self.folder / MANIFESTS / f"{len(kept):06d}.json", present.read_bytes())
            return found
        return newest

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

    def append(self, name: str, record: Mapping[str, Any]) -> None:
        """Append one JSON line to `name`. A run that had ended is sealed anew."""
        append_lines(self.folder / name, record)
        if (self.folder / SEAL).is_file():
            self.seal()

    def receipt(self, record: Mapping[str, Any], files: Mapping[str, Any]) -> None:
        """Append a receipt, chained to the one before it, the manifest and its round's files (as of `written`)."""
        chain = {"manifest": manifest_digest(self.folder), "files": dict(files), "previous": last_digest(self.folder)}
        append_lines(self.folder / UPDATES, {**record, "chain": chain})

    def seal(self) -> str:
        """End the chain; returns its head, the digest of the seal."""
        blob = json.dumps(seal_of(self.folder), indent=1, sort_keys=True) + "\n"
        write_atomic(self.folder / SEAL, blob)
        return digest(blob)

    def unseal(self) -> None:
        """The run goes on."""
        (self.folder / SEAL).unlink(missing_ok=True)

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

    def rewind_to(self, step: int) -> None:
        """Drop what the run holds beyond checkpoint `step`: the resumed run writes it again."""
        self.rewind(METRICS, "step", step)
        self.rewind(UPDATES, "round", step - 1)
        self.rewind(EVALUATIONS, "step", step)
        for path in round_files(self.folder):
            if int(path.name[:6]) >= step:
                path.unlink()


def round_files(folder: Path) -> list[Path]:
    """The trajectory files of all rounds, in `trajectories` and in every other folder of the run that has some."""
    return sorted(p for p in folder.glob("*/[0-9][0-9][0-9][0-9][0-9][0-9]*.jsonl") if p.is_file())


def last_digest(folder: Path) -> str:
    """Digest of the last receipt's line; empty if there is none."""
    last = last_line(folder / UPDATES)
    return digest(last) if last else ""


def manifest_digest(folder: Path) -> str:
    """Digest of the manifest; empty if there is none."""
    return file_digest(folder / MANIFEST) if (folder / MANIFEST).is_file() else ""


def seal_of(folder: Path) -> dict[str, Any]:
    """What a run's seal must hold."""
    logs = {name: [digest(line)[:16] for _, line in whole_lines(folder / name)] for name in LOGGED}
    sizes = {name: (folder / name).stat().st_size for name in (UPDATES, *LOGGED) if (folder / name).is_file()}
    return {
        "format": FORMAT,
        "updates": sum(1 for _ in whole_lines(folder / UPDATES)),
        "last_receipt": last_digest(folder),
        "manifest": manifest_digest(folder),
        "logs": {name: lines for name, lines in logs.items() if lines},
        "sizes": sizes,
    }
