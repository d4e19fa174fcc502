"""Whether the records of a run are those that were written: digests, links, files without a receipt, the seal.

Nothing here knows what a record means. What can be told without anything from outside the folder: every edit whose
author did not compute all later digests anew. Who did can be told by the head of the chain, if it was kept elsewhere.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from agentspec.files import digest, file_digest, parse_line, whole_lines
from agentspec.records.digests import differing, field_digests
from agentspec.records.folder import (
    FORMAT,
    MANIFEST,
    MANIFESTS,
    MEMORY,
    METRICS,
    SEAL,
    SEALED,
    TRAINER_STATE,
    TRAJECTORIES,
    UPDATES,
    checkpoints,
    digest_of,
    round_files,
)
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory


def read_manifests(folder: Path) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """All manifests of a run by digest, the present one last, and what is wrong with them.

    Raises:
        SpecError: one is not the manifest of a training run, or of another format.
    """
    found: dict[str, dict[str, Any]] = {}
    problems, before = [], ""
    for path in (*sorted((folder / MANIFESTS).glob("*.json")), folder / MANIFEST):
        name, key = path.relative_to(folder).as_posix(), file_digest(path)
        if key in found:
            continue
        data = found[key] = _manifest(path)
        edited = differing(data.get("digests"), field_digests({k: v for k, v in data.items() if k != "digests"}))
        problems += [f"{name}: {what} was edited" for what in edited]
        if data.get("previous") != before:
            problems.append(f"{name}: the manifest before it was edited, deleted or replaced (`previous`)")
        before = key
    return found, problems


def _manifest(path: Path) -> dict[str, Any]:
    try:
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        _ = data["config"]["output_dir"]
    except (ValueError, KeyError, TypeError) as error:
        raise SpecError(f"{path} is not the manifest of a training run ({type(error).__name__}: {error})") from error
    if data.get("format") != FORMAT:
        raise SpecError(
            f"{path} has format {data.get('format')!r}, expected {FORMAT}; audit it with the version that wrote it "
            "(`versions`), if it was not edited"
        )
    return data


def manifest_of(
    record: Mapping[str, Any], manifests: Mapping[str, dict[str, Any]], problems: list[str]
) -> dict[str, Any]:
    """The manifest that a receipt names; the present one, and a problem, if there is none."""
    named = chain_of(record).get("manifest")
    if named not in manifests:
        problems.append(f"{MANIFEST} is not the one that the receipt names (`chain.manifest`): one of them was edited")
    return manifests.get(str(named)) or list(manifests.values())[-1]


def linked_receipts(folder: Path) -> Iterator[tuple[dict[str, Any], list[str]]]:
    """Every receipt with what is wrong with its place in the chain."""
    path, before = folder / UPDATES, ""
    for number, line in whole_lines(path):
        record = parse_line(path, number, line)
        held = chain_of(record).get("previous") == before
        told = f"{UPDATES}, record {number}: what it followed was edited, deleted, doubled or moved (`chain.previous`)"
        yield record, [] if held else [told]
        before = digest(line)


def chain_of(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a receipt says of other records."""
    return _mapping(record.get("chain"))


def files_of(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """What a receipt says of its round's files."""
    return _mapping(chain_of(record).get("files"))


def read_round(folder: Path, record: Mapping[str, Any], problems: list[str]) -> dict[str, list[Trajectory]]:
    """The episodes of a receipt's round by the run's folder they lie in, each in the order of the global batch.

    Every edit of a file of the round is told.
    """
    present = {p.relative_to(folder).as_posix(): p for p in round_files(folder)}
    episodes: dict[str, list[Trajectory]] = defaultdict(list)
    for name, stated in sorted(files_of(record).items(), key=lambda item: (_rank(item[0]), item[0])):
        if name in present:
            episodes[name.partition("/")[0]] += _read_file(present[name], name, _mapping(stated), problems)
        else:
            problems.append(f"{name} is missing")
    return episodes


def _rank(name: str) -> int:
    number = Path(name).stem.partition(".rank")[2]
    return int(number) if number.isdigit() else 0


def _read_file(path: Path, name: str, stated: Mapping[str, Any], problems: list[str]) -> list[Trajectory]:
    """The episodes of one file, compared record by record with what the receipt states of it."""
    known = stated["episodes"] if isinstance(stated.get("episodes"), list) else []
    lines, episodes, told = list(whole_lines(path)), [], len(problems)
    for place, (number, line) in enumerate(lines):
        data = parse_line(path, number, line)
        which = f"{name}, record {number}"
        try:
            episodes.append(Trajectory.from_data(data))
            which = f"{which} ({episodes[-1].episode})"
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            problems.append(f"{which} is no trajectory any more ({type(error).__name__}: {error})")
        if place < len(known) and (edited := differing(known[place], field_digests(data))):
            problems.append(f"{which}: edited: {', '.join(edited)}")
    if len(lines) != len(known):
        problems.append(f"{name} has {len(lines)} records, the receipt names {len(known)}")
    if file_digest(path) != stated.get("digest") and len(problems) == told:
        problems.append(f"{name} or its digest in the receipt (`chain.files`) was edited; its records read as before")
    return episodes


def check_end(folder: Path, config: Mapping[str, Any], head: str = "") -> tuple[list[str], list[str]]:
    """What is wrong with the end of the chain, and what nobody can tell.

    Args:
        config: of the present manifest.
        head: what the run printed at its end; empty: not known.
    """
    named, carried, last, reached = set[str](), [""], -1, 0
    for record, _ in linked_receipts(folder):
        named |= set(files_of(record))
        carried.append(str(chain_of(record).get("memory", "")))
        last = record["round"] if isinstance(record.get("round"), int) else last
        reached = max(reached, last + steps_per_round(_mapping(record.get("settings"))))
    sealed = (folder / SEAL).is_file()
    problems = _check_seal(folder, head) if sealed else []
    steps = {METRICS: max((_step(line) for _, line in whole_lines(folder / METRICS)), default=0)}
    steps |= {p.name: int(p.name.rpartition("-")[2]) for p in checkpoints(folder)}
    problems += [
        f"{name} is of step {step}, but the receipts end at step {reached}: later ones are missing"
        for name, step in steps.items()
        if step > reached
    ]
    for path in sorted({*round_files(folder), *(folder / TRAJECTORIES).glob("[!.]*")}):
        name, number = path.relative_to(folder).as_posix(), path.name[:6]
        if name not in named and (sealed or not number.isdigit() or int(number) <= last):  # else a round under way
            problems.append(f"{name}: no receipt names it")
    if digest_of(folder / MEMORY) not in carried[-1 if sealed else -2 :]:  # it is written after the receipt
        problems.append(f"{MEMORY} is not what the last receipt says (`chain.memory`): it was edited or replaced")
    if sealed:
        return problems, []
    wanted = _wanted(folder, config)
    if head or (reached >= wanted and (max(steps.values()) >= wanted or any(folder.glob("*.safetensors")))):
        why = f"the head {head} is that of a run that had ended" if head else f"all {reached} steps were made"
        return [*problems, f"{SEAL} is missing, and {why}: it was deleted, or the run killed at its very end"], []
    return problems, [f"no {SEAL}: interrupted or under way after update {last}; nothing after its receipt is covered"]


def steps_per_round(given: Mapping[str, Any]) -> int:
    """Optimiser steps that are made of one generation round, by the settings of its trainer."""
    names = ("steps_per_generation", "num_iterations", "gradient_accumulation_steps")
    made, repeated, taken = (n if isinstance(n := given.get(name), int) and n > 0 else 1 for name in names)
    return max(1, made * repeated // taken)


def _step(line: bytes) -> int:
    with suppress(ValueError, AttributeError):
        step = json.loads(line).get("step")
        return step if isinstance(step, int) else 0
    return 0


def _wanted(folder: Path, config: Mapping[str, Any]) -> float:
    """Optimiser steps of the whole run; infinite where neither manifest nor checkpoint says."""
    counts = [config.get("max_steps")]
    with suppress(ValueError, OSError, IndexError, AttributeError):
        state = checkpoints(folder)[-1] / TRAINER_STATE
        counts.append(json.loads(state.read_text(encoding="utf-8")).get("max_steps"))
    return next((n for n in counts if isinstance(n, int) and n > 0), math.inf)


def seal_of(folder: Path) -> str:
    """The seal of a folder as it is: of every record its digest and, of a file of lines, 16 digits of each line's."""
    files = {}
    for path in (folder / name for name in SEALED if (folder / name).is_file()):
        lines = [digest(line)[:16] for _, line in whole_lines(path)] if path.suffix == ".jsonl" else []
        files[path.name] = {"digest": file_digest(path), "lines": lines}
    return json.dumps({"format": FORMAT, "files": files}, indent=1, sort_keys=True) + "\n"


def _check_seal(folder: Path, head: str) -> list[str]:
    blob, expected = (folder / SEAL).read_bytes(), seal_of(folder).encode()
    problems = []
    if blob != expected:
        sealed: Mapping[str, Any] = {}
        with suppress(ValueError):
            sealed = _mapping(_mapping(json.loads(blob)).get("files"))
        found = json.loads(expected)["files"]
        for name in sorted({*sealed, *found}):
            problems += _differences(name, sealed.get(name), found.get(name))
        problems = problems or [f"{SEAL} was edited"]
    if head and digest(blob) != head:
        problems.append(f"the head of the chain is {digest(blob)}, not {head}: the records are not those of that run")
    return problems


def _differences(name: str, sealed: Any, found: Any) -> list[str]:
    """How a file differs from what the seal says of it."""
    then, now = _mapping(sealed).get("lines"), _mapping(found).get("lines")
    if sealed == found:
        return []
    if not isinstance(then, list) or now is None:
        return [f"{name} was {'deleted' if now is None else 'added'} after the run's end, or {SEAL} edited"]
    edited = [i for i, (a, b) in enumerate(zip(then, now, strict=False), 1) if a != b]
    problems = [f"{name}, record {i}: edited, or its digest in {SEAL}" for i in edited]
    if len(then) != len(now):
        problems.append(f"{name} has {len(now)} records, {SEAL} says {len(then)}")
    return problems or [f"{name} or its digest in {SEAL} was edited; its records read as before"]


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
