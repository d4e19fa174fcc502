"""What a carried memory holds, as text: read, compared, exported.

A memory file (`agentspec.carry`) holds the states of memory and reflection by task. A module that has a method
`describe() -> str` says itself what its state means; of any other the snapshot's JSON is written out, key by key, with
long rows of numbers left out. Nothing here calls a model, and nothing of a file is executed.
"""

from __future__ import annotations

import base64
import binascii
import difflib
import json
from collections.abc import Iterator, Mapping
from typing import Any

from agentspec.carry import MemoryBank
from agentspec.embedding import HashEmbedder
from agentspec.llm.none import NoLLM
from agentspec.llm.recorder import Recorder
from agentspec.protocols import Described
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.state import load_state

KINDS = ("memory", "reflection")
START = "start"
NUMBERS = 8
"""Rows of more numbers than these are counted, not written out."""


def entries(bank: MemoryBank) -> dict[str, str]:
    """Task key -> state; what tasks without one start from is called `start`."""
    return {**({START: bank.start} if bank.start else {}), **bank.states}


def chosen(bank: MemoryBank, task: str = "") -> dict[str, str]:
    """The entry of `task` (a key, or the beginning of one), or all.

    Raises:
        SpecError: no entry, or several, begin so.
    """
    everything = entries(bank)
    found = {key: state for key, state in everything.items() if key.startswith(task)}
    if task and len(found) != 1:
        raise SpecError(f"--task {task!r} names {len(found)} entries; the file has {', '.join(everything) or 'none'}")
    return found


def describe(bank: MemoryBank, state: str) -> dict[str, list[str]]:
    """Lines by `kind name` (`memory base`), of those modules that carry anything.

    Args:
        bank: whose modules they are.
        state: one of its states.
    """
    data = load_state(state.encode())
    own = _own_words(bank, state)
    described = {"time": [_time(data["time"])]}
    for kind, name in zip(KINDS, bank.modules, strict=True):
        blob = base64.b64decode(data[kind])
        if name != "none":
            described[f"{kind} {name}"] = own.get(kind) or list(_lines(_readable(blob)))
    return described


def _own_words(bank: MemoryBank, state: str) -> dict[str, list[str]]:
    """What the modules that can say so say of the state; none where they are not there or cannot take it up."""
    modules = dict(zip(KINDS, bank.modules, strict=True))
    try:
        spec = AgentSpec.from_data({**modules, "scope": "run", "embedder": "hash"})
        agent = spec.build(Recorder(NoLLM(), episode="", seed=0), embedder=HashEmbedder())
        agent.resume(state.encode())
        parts = {kind: getattr(agent, kind) for kind in KINDS}
        return {kind: part.describe().splitlines() for kind, part in parts.items() if isinstance(part, Described)}
    except Exception:  # whatever a module of another version, or of nowhere, does: its JSON can still be read
        return {}


def text(bank: MemoryBank, task: str = "") -> list[str]:
    """Everything a bank holds (or one task's part), as lines."""
    memory, reflection = bank.modules
    lines = [f"memory: {memory}, reflection: {reflection}, {len(bank.states)} tasks"]
    for key, state in chosen(bank, task).items():
        lines += ["", f"{'task ' if key != START else ''}{key}{' (latest)' if key == bank.latest else ''}"]
        for heading, described in describe(bank, state).items():
            lines += [f"  {heading}", *(f"    {line}" for line in described or ["(empty)"])]
    return lines


def data(bank: MemoryBank, task: str = "") -> dict[str, Any]:
    """As `text`, as JSON data with the states decoded."""
    found = {}
    for key, state in chosen(bank, task).items():
        parts = load_state(state.encode())
        found[key] = {"time": parts["time"], **{k: _readable(base64.b64decode(parts[k])) for k in KINDS}}
    return {"modules": dict(zip(KINDS, bank.modules, strict=True)), "latest": bank.latest, "states": found}


def diff(one: MemoryBank, other: MemoryBank, task: str = "") -> list[str]:
    """What the second holds that the first does not, and the other way round, as a unified diff.

    Tasks that both know are compared one by one; where there is none, what each carried last.
    """
    pairs: list[tuple[str, str, str]] = []
    mine, theirs = entries(one), entries(other)
    shared = [key for key in mine if key in theirs and key.startswith(task)]
    if task and not shared:
        known = ", ".join(key for key in mine if key in theirs)
        raise SpecError(f"--task {task!r} names no task that both files hold; they share {known or 'none'}")
    for key in shared:
        pairs.append((key, mine[key], theirs[key]))
    if not shared:
        first, second = (bank.states.get(bank.latest, bank.start) for bank in (one, other))
        pairs.append(("latest", first, second))
    lines: list[str] = []
    for key, before, after in pairs:
        a, b = (_flat(bank, state) if state else [] for bank, state in ((one, before), (other, after)))
        lines += difflib.unified_diff(a, b, f"{key} (first)", f"{key} (second)", lineterm="", n=1)
    return lines or ["no difference"]


def _flat(bank: MemoryBank, state: str) -> list[str]:
    parts = describe(bank, state)
    return [line for heading, lines in parts.items() for line in (heading, *(f"  {line}" for line in lines))]


def _time(time: Mapping[str, Any]) -> str:
    return f"{time['episode']} episodes, {time['before']} steps"


def _readable(blob: bytes) -> Any:
    """JSON, JSON within base64, text, or how many bytes there are."""
    for decode in (lambda b: b, lambda b: base64.b64decode(b, validate=True)):
        try:
            return json.loads(decode(blob).decode())
        except (ValueError, binascii.Error):
            continue
    try:
        return blob.decode()
    except UnicodeDecodeError:
        return f"({len(blob)} bytes)"


def _lines(value: Any, indent: str = "") -> Iterator[str]:
    """JSON data as indented lines; what is empty says nothing."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _named(f"{key}:", inner, indent)
    elif isinstance(value, list):
        if len(value) > NUMBERS and all(isinstance(v, (int, float)) for v in value):
            yield f"{indent}({len(value)} numbers)"
            return
        for inner in value:
            yield from _named("-", inner, indent)
    elif value not in ("", None):
        yield from (f"{indent}{line}" for line in str(value).splitlines())


def _named(name: str, value: Any, indent: str) -> Iterator[str]:
    """A value under its name: on the same line where it is one line."""
    lines = list(_lines(value, ""))
    if len(lines) == 1 and not isinstance(value, (Mapping, list)):
        yield f"{indent}{name} {lines[0]}"
    elif lines:
        head, rest = (lines[0], lines[1:]) if name == "-" else ("", lines)
        yield f"{indent}{name} {head}".rstrip()
        yield from (f"{indent}  {line}" for line in rest)
