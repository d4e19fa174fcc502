"""What somebody might change in the records of a run afterwards, one function per kind, in the files' own spelling."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from agentspec.files import json_line
from agentspec.state import dump_state

UPDATES, MANIFEST, SEAL, MEMORY = "updates.jsonl", "manifest.json", "seal.json", "memory.json"
METRICS, EVALUATIONS = "metrics.jsonl", "evaluations.jsonl"
EPISODES = "trajectories/{:06d}.jsonl"

Records = list[dict[str, Any]]
Change = Callable[[Records], None]


def read(path: Path) -> Records:
    """Records of a file; a file that holds one JSON object is one record."""
    text = path.read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()] if path.suffix == ".jsonl" else [json.loads(text)]


def spelled(path: Path, records: Records) -> str:
    """The records as the run itself writes them into such a file."""
    if path.name == MANIFEST:
        return json.dumps(records[0], indent=2, sort_keys=True) + "\n"
    if path.name == SEAL:
        return json.dumps(records[0], indent=1, sort_keys=True) + "\n"
    if path.name == MEMORY:
        return dump_state(records[0]).decode()
    if path.parent.name == "trajectories":
        return "".join(json.dumps(r, sort_keys=True, separators=(",", ":"), ensure_ascii=False) + "\n" for r in records)
    return "".join(map(json_line, records))


def edit(path: Path, change: Change) -> None:
    """Change the records of a file in place."""
    records = read(path)
    change(records)
    path.write_text(spelled(path, records), encoding="utf-8")


# --- generically: every leaf -----------------------------------------------------------------------------------------

Where = tuple[Any, ...]


def leaves(data: Any, where: Where = ()) -> Iterator[Where]:
    """Paths of all values that hold no others (empty lists and mappings among them)."""
    if isinstance(data, dict) and data:
        for key in data:
            yield from leaves(data[key], (*where, key))
    elif isinstance(data, list) and data:
        for i, value in enumerate(data):
            yield from leaves(value, (*where, i))
    else:
        yield where


def other(value: Any) -> Any:
    """A value of the same kind that is not `value`."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    if isinstance(value, str):
        return value + "x"
    return {None: 0, "[]": [0], "{}": {"x": 0}}[value if value is None else json.dumps(value)]


def change_leaf(data: Any, where: Where) -> None:
    """Give one leaf another value."""
    for key in where[:-1]:
        data = data[key]
    data[where[-1]] = other(data[where[-1]])


# --- by kind ---------------------------------------------------------------------------------------------------------


def calls(record: dict[str, Any]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Calls of an episode that were trained, with their executed completion."""
    for call in record["calls"]:
        for completion in call["completions"]:
            if completion["credit"] == "executed":
                yield call, completion


def places(record: dict[str, Any], *, forced: bool) -> tuple[dict[str, Any], int]:
    """A completion and a position in it that its constraint forced, or left a choice."""
    for _, completion in calls(record):
        for i, allowed in enumerate(completion["allowed"]):
            if allowed is not None and (len(allowed) == 1) == forced:
                return completion, i
    raise LookupError(f"no {'forced' if forced else 'free'} token under a constraint in this episode")


def _logprobs(records: Records) -> None:
    for _, completion in calls(records[0]):
        completion["logprobs"] = [p - 3.0 for p in completion["logprobs"]]


def _forced_logprob(records: Records) -> None:
    completion, i = places(records[0], forced=True)
    completion["logprobs"][i] = -3.0


def _sampling(name: str, value: float) -> Change:
    def change(records: Records) -> None:
        call, _ = next(calls(records[0]))
        assert call["sampling"][name] != value
        call["sampling"][name] = value

    return change


def _wider(records: Records) -> None:
    completion, i = places(records[0], forced=False)
    completion["allowed"][i] = sorted({*completion["allowed"][i], 0, 1, 2, 3})


def _elsewhere(records: Records) -> None:
    completion, i = places(records[0], forced=False)
    completion["allowed"][i] = [t for t in (1, 2, 3) if t != completion["token_ids"][i]][:2]


def _freed(records: Records) -> None:
    completion, _ = places(records[0], forced=True)
    completion["allowed"] = []


def _resampled(records: Records) -> None:
    _, completion = next(calls(records[0]))
    completion["token_ids"][0] += 1


def _set(*where: Any, value: Any) -> Change:
    def change(records: Records) -> None:
        data: Any = records
        for key in where[:-1]:
            data = data[key]
        assert data[where[-1]] != value, where
        data[where[-1]] = value

    return change


def _completion(name: str, value: Any, instead: Any = None) -> Change:
    def change(records: Records) -> None:
        _, completion = next(calls(records[0]))
        completion[name] = instead if completion[name] == value else value

    return change


def _richer(records: Records) -> None:
    """The same for all members of the first group: advantages stay what they are."""
    for record in records[:2]:
        last = record["steps"][-1]
        last["reward"] += 5.0
        last["info"]["balance"] += 5.0
        record["metrics"]["return"] = record["metrics"].get("return", 0.0) + 5.0


def _richer_receipt(records: Records) -> None:
    records[1]["returns"][:2] = [value + 5.0 for value in records[1]["returns"][:2]]


def _other_memory(records: Records) -> None:
    states = records[0]["states"]
    name = next(iter(states))
    states[name] = states[name].replace("a", "o", 1) + " "


First = EPISODES.format(0)
Second = EPISODES.format(1)

KINDS: dict[str, list[tuple[str, Change]]] = {
    "log-probabilities of all sampled tokens": [(Second, _logprobs)],
    "log-probability of a forced token": [(Second, _forced_logprob)],
    "temperature of a trained call": [(Second, _sampling("temperature", 0.5))],
    "top_p of a trained call": [(Second, _sampling("top_p", 0.5))],
    "top_k of a trained call": [(Second, _sampling("top_k", 5))],
    "constraint widened": [(Second, _wider)],
    "constraint without the sampled token": [(Second, _elsewhere)],
    "constraint lifted": [(Second, _freed)],
    "sampled token": [(Second, _resampled)],
    "action text": [(Second, _set(0, "steps", 0, "action", value="SELL(7)"))],
    "observation text": [(Second, _set(0, "steps", 0, "text", value="The price is 99."))],
    "completion text": [(Second, _completion("text", "wait a week"))],
    "finish reason": [(Second, _completion("finish_reason", "length", "stop"))],
    "credit of a completion": [(Second, _completion("credit", "aux"))],
    "spec of an episode": [(Second, _set(0, "spec", "reasoning", value="cot"))],
    "versions of an episode": [(Second, _set(0, "versions", "numpy", value="0.0"))],
    "policy of an episode": [(Second, _set(0, "policy", value="step-7"))],
    "status of an episode": [(Second, _set(0, "status", value="failed"))],
    "reward of a step": [(Second, _set(0, "steps", 0, "reward", value=1e3))],
    "the same added to all returns of a group": [(Second, _richer), (UPDATES, _richer_receipt)],
    "an episode deleted": [(Second, lambda r: r.pop() and None)],
    "episodes reordered": [(Second, lambda r: r.reverse())],
    "the first update deleted": [(UPDATES, lambda r: r.pop(0) and None)],
    "an update deleted": [(UPDATES, lambda r: r.pop(1) and None)],
    "the last update deleted": [(UPDATES, lambda r: r.pop() and None)],
    "an update doubled": [(UPDATES, lambda r: r.insert(1, r[1]))],
    "updates reordered": [(UPDATES, lambda r: r.insert(0, r.pop(1)))],
    "advantage in the receipt": [(UPDATES, _set(1, "rows", 0, "advantage", value=9.0))],
    "denominator in the receipt": [(UPDATES, _set(1, "denominator", value=1))],
    "padding rows in the receipt": [(UPDATES, _set(1, "padding_rows", value=50))],
    "a row deleted from the receipt": [(UPDATES, lambda r: r[1]["rows"].pop() and None)],
    "a row added to the receipt": [(UPDATES, lambda r: r[1]["rows"].append(r[1]["rows"][0]))],
    **{
        f"{name} in the {where}": [(file, _set(*path, name, value=value))]
        for name, value in (
            ("estimator", "rloo"),
            ("loss_type", "bnpo"),
            ("epsilon", 0.9),
            ("beta", 0.7),
            ("learning_rate", 1.0),
        )
        for where, file, path in (
            ("receipt", UPDATES, (1, "settings")),
            ("manifest", MANIFEST, (0, "config")),
        )
    },
    "spec in the manifest": [(MANIFEST, _set(0, "spec", "reasoning", value="cot"))],
    "versions in the manifest": [(MANIFEST, _set(0, "versions", "numpy", value="0.0"))],
    "logged metrics": [(METRICS, _set(1, "reward", value=1e3))],
    "an evaluation": [(EVALUATIONS, _set(0, "eval_reward", value=1e3))],
    "a memory that is carried": [(MEMORY, _other_memory)],
}
"""Kind -> what is done to which file of a run of at least three updates."""


def with_a_round_more(folder: Path) -> None:
    """A trajectory file that no update used."""
    (folder / EPISODES.format(900)).write_bytes((folder / First).read_bytes())


def with_spaces(folder: Path) -> None:
    """The same JSON in other bytes."""
    path = folder / Second
    path.write_bytes(path.read_bytes().replace(b'":', b'": ', 1))


def with_a_file_of_another_name(folder: Path) -> None:
    """Episodes beside those of the rounds: whoever reads all of the folder would read them too."""
    (folder / First).with_name("more.jsonl").write_bytes((folder / First).read_bytes())


def without(name: str) -> Callable[[Path], None]:
    """A file that is gone."""

    def change(folder: Path) -> None:
        (folder / name).unlink()

    return change


def with_a_line_more(folder: Path) -> None:
    """A record that was written after the end."""
    with open(folder / METRICS, "a", encoding="utf-8") as file:
        file.write(json_line({"step": 3, "reward": 1e3}))


def with_bytes(name: str, old: bytes, new: bytes) -> Callable[[Path], None]:
    """A line that no reader looks at: `new` instead of the last `old`."""

    def change(folder: Path) -> None:
        before, _, after = (folder / name).read_bytes().rpartition(old)
        (folder / name).write_bytes(before + new + after)

    return change


FILE_KINDS: dict[str, Callable[[Path], None]] = {
    "a trajectory file deleted": without(First),
    "the memories deleted": without(MEMORY),
    "the seal deleted": without(SEAL),
    f"a line added to {METRICS}": with_a_line_more,
    "a trajectory file added": with_a_round_more,
    "bytes that read the same": with_spaces,
    "a trajectory file of another name added": with_a_file_of_another_name,
    **{f"a torn line in {name}": with_bytes(name, b"\n", b'\n{"step": 9') for name in (UPDATES, METRICS, EVALUATIONS)},
    **{f"a blank line in {name}": with_bytes(name, b"\n{", b"\n\n{") for name in (UPDATES, METRICS, EVALUATIONS)},
}
"""Kind -> what is done to a run's folder."""


def apply(folder: Path, kind: str) -> None:
    """Do one kind of edit to a run's folder."""
    if kind in FILE_KINDS:
        FILE_KINDS[kind](folder)
        return
    for file, change in KINDS[kind]:
        edit(folder / file, change)


def findings(run: Path, head: str = "") -> list[str]:
    """Violations that the audit finds; records that cannot be read at all are one."""
    from agentspec.registry import SpecError
    from trainers.audit import audit

    try:
        return [v for update in audit(run, head=head) for v in update.violations]
    except (SpecError, ValueError) as error:
        return [str(error)]
