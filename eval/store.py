"""The store: finished episodes on disk, found by everything that decides what an episode is.

It grows and nothing is ever taken away: `episodes.jsonl` has one line per finished episode, `states/` what a memory of
`scope: run` was after it. A line's key is the digest of its configuration (`configurations/DIGEST.json` says which:
agent, weights, sampling, package versions), its task, its repeat and the memory it started from. Names of policies and
scaffolds are no part of it: two matrices that ask for the same episode share it, and a changed scaffold under an old
name finds nothing of the old one.

An episode that failed may be played again; both lines stay. The first line that completed counts, and without one the
latest failure. A kill loses only what was under way: every line is on disk before the next episode is counted.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from agentspec.files import append_lines, digest, held, jsonable, parse_line, repair_lines, whole_lines, write_atomic
from agentspec.llm.pricing import Prices
from eval.repricing import repriced

EPISODES = "episodes.jsonl"
LOCK = ".lock"
Record = Mapping[str, Any]


class Store:
    """Finished episodes by key.

    Args:
        folder: where they are kept; made when the first one is added.
        prices: what episodes cost when they are read; `None`: what they cost when they were played.

    Raises:
        ValueError: a line that is no record of an episode, with its number.
    """

    def __init__(self, folder: str | Path, prices: Prices | None = None) -> None:
        self.folder, self.prices = Path(folder), prices
        self.path = self.folder / EPISODES
        self._records: dict[str, Record] = {}
        self._configurations: dict[str, str] = {}
        self.read()

    def read(self) -> None:
        """Read what is on disk now."""
        self._records = {}
        for number, line in whole_lines(self.path):
            record = parse_line(self.path, number, line)
            if not isinstance(record.get("key"), str) or not isinstance(record.get("episode"), dict):
                raise ValueError(
                    f"{self.path}, line {number} is no record of an episode (expected `key` and `episode`); "
                    "repair or remove the line, or choose another folder"
                )
            self._note(record)

    @contextmanager
    def writing(self) -> Iterator[Store]:
        """Alone in the folder: read again, cut off a torn last line, and keep other writers out.

        Raises:
            SpecError: somebody else is writing.
        """
        refusal = f"another evaluation is writing into {self.folder}"
        with held(self.folder / LOCK, refusal, "wait until it has ended, or choose another folder"):
            repair_lines(self.path)
            self.read()
            yield self

    def get(self, key: str) -> Record | None:
        """The episode that counts under `key`, at the store's prices."""
        record = self._records.get(key)
        return record if record is None or self.prices is None else repriced(record, self.prices)

    def __len__(self) -> int:
        return len(self._records)

    def add(self, key: str, record: Record, state: bytes | None = None) -> Record:
        """Append an episode, on disk when this returns.

        Args:
            key: of the episode.
            record: `episode` (its row, see `agentspec.metrics.episode_row`) and what else is to be known of it.
            state: what the memory was after it, where that outlives the episode.
        """
        if state is not None:
            name = digest(state)
            write_atomic(self._state(name), state)  # first: a line never names a state that is not there
            record = {**record, "state": name}
        self._keep_configuration(record.get("configuration", ""))
        line = jsonable({**record, "key": key})
        append_lines(self.path, line)
        self._note(line)
        return line

    def state(self, record: Record) -> bytes | None:
        """What the memory was after an episode; `None` where nothing outlives it.

        Raises:
            ValueError: the state's file is gone or changed.
        """
        if not (name := record.get("state")):
            return None
        path = self._state(name)
        blob = path.read_bytes() if path.is_file() else b""
        if digest(blob) != name:
            what = "changed" if blob else "missing"
            raise ValueError(f"{path} is {what}: the episodes after it cannot go on from it")
        return blob

    def describe(self, configuration: Mapping[str, Any]) -> str:
        """The digest that stands for a configuration in keys; it is written beside the first episode that has it."""
        text = json.dumps(jsonable(configuration), sort_keys=True, indent=1)
        name = digest(text)[:16]
        self._configurations[name] = text
        return name

    def _keep_configuration(self, name: str) -> None:
        text = self._configurations.pop(name, "")
        path = self.folder / "configurations" / f"{name}.json"
        if text and not path.is_file():
            write_atomic(path, text + "\n")

    def _state(self, name: str) -> Path:
        return self.folder / "states" / f"{name[:32]}.json"

    def _note(self, record: Record) -> None:
        before = self._records.get(record["key"])
        if before is None or before["episode"].get("status") != "completed":
            self._records[record["key"]] = record
