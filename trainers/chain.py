"""Whether the records of a run are those that were written: digests, links, files without a receipt, the seal.

Nothing here knows what a record means. What can be told without anything from outside the folder: every edit whose
author did not compute all later digests anew. Who did can be told by the head of the chain, if it was kept elsewhere.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agentspec.files import digest, file_digest, parse_line, whole_lines
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory
from trainers.digests import differing, field_digests
from trainers.run_folder import CHECKPOINT, MANIFEST, MANIFESTS, METRICS, SEAL, TRAJECTORIES, UPDATES, checkpoints
from trainers.runlog import FORMAT, round_files, seal_of

SHOWN = 20
"""Edited records of one file that are listed one by one."""


# --- manifests -------------------------------------------------------------------------------------------------------


@dataclass
class Manifests:
    """All manifests of a run by digest, the present one last, and what is wrong with them."""

    by_digest: dict[str, dict[str, Any]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @classmethod
    def read(cls, folder: Path) -> Manifests:
        """Read them.

        Raises:
            SpecError: the present one is not the manifest of a training run.
        """
        found = cls()
        before = ""
        for path in (*sorted((folder / MANIFESTS).glob("*.json")), folder / MANIFEST):
            name = path.relative_to(folder).as_posix()
            key = file_digest(path)
            if key in found.by_digest:
                continue
            data = _manifest(path)
            edited = differing(data.get("digests"), field_digests({k: v for k, v in data.items() if k != "digests"}))
            found.problems += [f"{name}: {what} was edited" for what in edited]
            if data.get("previous") != before:
                found.problems.append(f"{name}: the manifest before it was edited, deleted or replaced (`previous`)")
            found.by_digest[key] = data
            before = key
        return found

    def of(self, record: Mapping[str, Any], problems: list[str]) -> dict[str, Any]:
        """The manifest that a receipt names; the present one, and a problem, if there is none."""
        named = _chain(record).get("manifest")
        if named not in self.by_digest:
            problems.append(
                f"{MANIFEST} is not the one that the receipt names (`chain.manifest`): one of them was edited"
            )
        return self.by_digest.get(str(named)) or next(reversed(self.by_digest.values()))


def _manifest(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SpecError(f"{path} is not JSON ({error}); the run's record is damaged") from error
    if not isinstance(data, dict) or not isinstance(data.get("config"), dict):
        raise SpecError(f"{path} names no configuration: it is not the manifest of a training run")
    return data


# --- receipts --------------------------------------------------------------------------------------------------------


def linked_receipts(folder: Path) -> Iterator[tuple[dict[str, Any], list[str]]]:
    """Every receipt with what is wrong with its place in the chain.

    A link that does not hold is told of the earlier of its two receipts: it was edited, or what follows it is not what
    did. Only what the next receipt says of a receipt can tell.
    """
    path = folder / UPDATES
    numbers = {digest(line): number for number, line in whole_lines(path)}
    held: tuple[dict[str, Any], list[str], str] | None = None
    for number, line in whole_lines(path):
        record = parse_line(path, number, line)
        problems: list[str] = []
        if record.get("format") != FORMAT:
            problems.append(f"record {number} has format {record.get('format')!r}, expected {FORMAT} (`format`)")
        previous = _chain(record).get("previous")
        if held is None:
            if previous != "":
                problems.append(f"record {number} was not the first: those before it were deleted (`chain.previous`)")
        elif previous != held[2]:
            place = numbers.get(str(previous))
            what = f"followed record {place}: records were moved, deleted or doubled" if place else "was edited, or"
            what = what if place else "follows a record that is not here: the one before it was edited or deleted"
            (held[1] if not place else problems).append(f"record {number} of {UPDATES} {what} (`chain.previous`)")
        if held is not None:
            yield held[0], held[1]
        held = record, problems, digest(line)
    if held is not None:
        yield held[0], held[1]


def _chain(record: Mapping[str, Any]) -> Mapping[str, Any]:
    chain = record.get("chain")
    return chain if isinstance(chain, Mapping) else {}


def files_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """What a receipt says of its round's files."""
    files = _chain(record).get("files")
    return dict(files) if isinstance(files, Mapping) else {}


def read_round(folder: Path, record: Mapping[str, Any], problems: list[str]) -> dict[str, list[Trajectory]]:
    """The episodes of a receipt's round by the run's folder they lie in, each in the order of the global batch.

    Every edit of a file of the round is told.
    """
    present = {p.relative_to(folder).as_posix(): p for p in round_files(folder)}
    episodes: dict[str, list[Trajectory]] = defaultdict(list)
    for name, stated in sorted(files_of(record).items(), key=lambda item: (_rank(item[0]), item[0])):
        if name not in present:
            problems.append(f"{name} is missing")
            continue
        read = _read_file(present[name], name, stated if isinstance(stated, Mapping) else {}, problems)
        episodes[name.partition("/")[0]] += read
    return episodes


def _rank(name: str) -> int:
    number = Path(name).stem.partition(".rank")[2]
    return int(number) if number.isdigit() else 0


def _read_file(path: Path, name: str, stated: Mapping[str, Any], problems: list[str]) -> list[Trajectory]:
    """The episodes of one file, compared record by record with what the receipt states of it."""
    known = stated.get("episodes")
    known = known if isinstance(known, Sequence) else []
    episodes, told, count = [], len(problems), 0
    for number, line in whole_lines(path):
        count += 1
        data = parse_line(path, number, line)
        expected = known[count - 1] if count <= len(known) else {}
        edited = differing(expected, field_digests(data))
        try:
            episodes.append(Trajectory.from_data(data))
            which = f"record {number} ({episodes[-1].episode})"
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            which = f"record {number}"
            problems.append(f"{name}, {which} is no trajectory any more ({type(error).__name__}: {error})")
        if edited and count <= len(known):
            problems.append(f"{name}, {which}: edited: {', '.join(edited)}")
    if count != len(known):
        problems.append(f"{name} has {count} records, the receipt names {len(known)}")
    if file_digest(path) != stated.get("digest") and len(problems) == told:
        problems.append(f"{name} or its digest in the receipt (`chain.files`) was edited; its records read as before")
    return episodes


# --- the end of the chain --------------------------------------------------------------------------------------------


def check_end(
    folder: Path, receipts: Sequence[tuple[int, set[str], int]], head: str = ""
) -> tuple[list[str], list[str]]:
    """What is wrong with the end of the chain, and what nobody can tell.

    Args:
        receipts: of each receipt its round, the names of its files, and the optimiser steps that its round makes.
        head: what the run printed at its end; empty: not known.
    """
    problems, notes = _check_seal(folder, head)
    sealed = (folder / SEAL).is_file()
    last = max((number for number, _, _ in receipts), default=-1)
    named = set().union(*(files for _, files, _ in receipts))
    for path in round_files(folder):
        name = path.relative_to(folder).as_posix()
        if name not in named and (sealed or not int(path.name[:6]) > last):
            problems.append(f"{name}: no receipt names it")
    known = {p.name for p in round_files(folder)}
    for path in sorted((folder / TRAJECTORIES).glob("*")):
        if path.name not in known and not path.name.startswith("."):
            problems.append(f"{TRAJECTORIES}/{path.name}: no receipt names it, and no round has a file of that name")
    reached = max((number + steps for number, _, steps in receipts), default=0)
    steps = {METRICS: max((_step(line) for _, line in whole_lines(folder / METRICS)), default=0)}
    steps |= {p.name: int(p.name.removeprefix(f"{CHECKPOINT}-")) for p in checkpoints(folder)}
    for name, number in steps.items():
        if number > reached:
            problems.append(
                f"{name} is of step {number}, but the receipts end at step {reached}: later ones are missing"
            )
    return problems, notes


def _step(line: bytes) -> int:
    try:
        step = json.loads(line).get("step")
    except (ValueError, AttributeError):
        return 0
    return step if isinstance(step, int) else 0


def _check_seal(folder: Path, head: str) -> tuple[list[str], list[str]]:
    path = folder / SEAL
    if not path.is_file():
        if head:
            return [f"{SEAL} is missing, and the head {head} is that of a run that had ended"], []
        return [], [f"no {SEAL}: the run has not ended, or was cut short; what stood after its last receipt is unknown"]
    problems: list[str] = []
    blob = path.read_bytes()
    try:
        seal = json.loads(blob)
    except ValueError as error:
        return [f"{SEAL} is not JSON ({error})"], []
    expected = seal_of(folder)
    if not isinstance(seal, dict):
        return [f"{SEAL} is no seal"], []
    for name in sorted({*seal, *expected}):
        if seal.get(name) != expected.get(name):
            if name == "logs":
                problems += _log_problems(seal.get(name), expected[name])
            elif name == "sizes":
                problems += _size_problems(seal.get(name), expected[name])
            else:
                problems.append(_SEALED.get(name, name))
    if not problems and blob != (json.dumps(expected, indent=1, sort_keys=True) + "\n").encode():
        problems.append(f"{SEAL}: its bytes were edited")
    if head and digest(blob) != head:
        problems.append(f"the head of the chain is {digest(blob)}, not {head}: the records are not those of that run")
    return problems, []


_SEALED = {
    "last_receipt": f"the last record of {UPDATES} is not that of {SEAL} (`last_receipt`): it was edited or deleted",
    "updates": f"{UPDATES} has not as many records as {SEAL} says (`updates`)",
    "manifest": f"{MANIFEST} is not the one that {SEAL} names (`manifest`)",
    "format": f"{SEAL}: `format` was edited",
}


def _size_problems(sealed: Any, found: Mapping[str, int]) -> list[str]:
    if not isinstance(sealed, Mapping):
        return [f"{SEAL}: `sizes` was edited"]
    return [
        f"{name} has {found.get(name, 0)} bytes, {SEAL} says {sealed.get(name, 0)} (`sizes`)"
        for name in sorted({*sealed, *found})
        if sealed.get(name) != found.get(name)
    ]


def _log_problems(sealed: Any, found: Mapping[str, list[str]]) -> list[str]:
    if not isinstance(sealed, Mapping):
        return [f"{SEAL}: `logs` was edited"]
    problems = []
    for name in sorted({*sealed, *found}):
        then, now = sealed.get(name) or [], found.get(name) or []
        if len(then) != len(now):
            problems.append(f"{name} has {len(now)} records, {SEAL} says {len(then)} (`logs`)")
        edited = [i for i, (a, b) in enumerate(zip(then, now, strict=False), 1) if a != b]
        problems += [
            f"{name}, record {i}: logged metrics edited, or its digest in {SEAL} (`logs`)" for i in edited[:SHOWN]
        ]
    return problems
