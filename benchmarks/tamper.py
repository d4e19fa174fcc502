"""Whether an edited record is noticed: every kind of edit, every field, once.

    python -m benchmarks.tamper [--json]

A tiny honest run is made (a random model, groups of two, a memory that asks the model and is carried over episodes,
menus, evaluation while training). Then, on a copy each time, one thing is changed and the audit is run: each of the
kinds of `benchmarks.edits`, and every leaf of one receipt, one trajectory, the manifest, the seal, the memories that
are carried, one line of metrics and one of evaluations. Honest runs of every estimator, and of other settings that
change what an update is made of, must have no violation at all.

Files that are only shown to people or can be computed again (plots, evaluation tables, the weights, what the terminal
saw) are no records and are not covered: `excepted` names them. Times are recorded, and covered like everything else.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.edits import (
    EPISODES,
    EVALUATIONS,
    FILE_KINDS,
    KINDS,
    MANIFEST,
    MEMORY,
    METRICS,
    SEAL,
    UPDATES,
    apply,
    change_leaf,
    findings,
    leaves,
    read,
    spelled,
)

EXCEPTED = {
    "run.lock": "names the process that writes, while it does",
    "checkpoint-*, adapter and model files": "weights; `agentspec export` writes digests of its own",
    "reward_curve.png, evaluation.md, evaluation.jsonl": "written after the run, computed from checkpoints",
    "terminal": "printed, not recorded",
}
RUN: dict[str, Any] = {
    "agent": {
        "reasoning": "react",
        "memory": {"name": "summary", "every": 1, "summary_tokens": 4},
        "scope": "run",
        "sampling": {"max_tokens": 4},
    },
    "train_calls": ["reasoning.*", "memory.summary"],
    "eval_strategy": "steps",
    "eval_steps": 1,
    "validation_tasks": 1,
    "max_steps": 3,
}
HONEST: dict[str, dict[str, Any]] = {
    "failed episodes": {"faults": {(1, 0): "crash"}},
    "normalize: rollout": {"normalize": "rollout", **{k: RUN[k] for k in ("agent", "train_calls")}},
    "skip_zero_variance": {"skip_zero_variance": True},
    "overlong: drop": {"overlong": "drop", "overlong_ends": ["max_steps", "truncated"]},
    "several updates per round": {"steps_per_generation": 4, "max_steps": 3},
    "several iterations": {"num_iterations": 2, "max_steps": 3},
    "padded rows": {"packing": "padded", "estimator": "rloo"},
    "free text": {"menu": False},
}
"""Settings that change what an update is made of, beside every estimator."""


def main() -> None:
    """Edit, audit, count; JSON or a summary."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0], allow_abbrev=False)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every N-th leaf of a record")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(sys.stderr):
        result = tamper(Path(name), options.every)
    if options.json:
        print(json.dumps(result))
        return
    print(f"{result['noticed']} of {result['edits']} edits noticed, {result['named']} by the name of the file")
    print(f"{result['honest_runs']} honest runs, {result['honest_violations']} violations")
    for missed in result["missed"]:
        print(f"  missed: {missed}")


def tamper(folder: Path, every: int = 1) -> dict[str, Any]:
    """Make the runs, make the edits.

    Args:
        folder: empty, for the runs.
        every: change only every n-th leaf of a record.
    """
    honest = folder / "honest"
    head = train(honest, **RUN)
    clean = honest_runs(folder, head)
    tally = Tally()
    for kind in (*KINDS, *FILE_KINDS):
        run = Path(shutil.copytree(honest, folder / "edited"))
        apply(run, kind)
        tally.add(kind, findings(run), [file for file, _ in KINDS.get(kind, [])])
        shutil.rmtree(run)
    for file, number in (
        (UPDATES, 1),
        (EPISODES.format(1), 0),
        (MANIFEST, 0),
        (SEAL, 0),
        (MEMORY, 0),
        (METRICS, 1),
        (EVALUATIONS, 1),
    ):
        every_leaf(honest, file, number, every, tally)
    if findings(honest, head):
        raise RuntimeError("the honest run was not left as it was")
    return tally.result() | {
        "honest_runs": len(clean),
        "honest_violations": sum(map(len, clean.values())),
        "honest": {name: found for name, found in clean.items() if found},
        "excepted": EXCEPTED,
    }


class Tally:
    """What was edited and what was noticed."""

    def __init__(self) -> None:
        self.edits, self.noticed, self.named = 0, 0, 0
        self.missed: list[str] = []
        self.unnamed: list[str] = []

    def add(self, what: str, found: Sequence[str], files: Sequence[str]) -> None:
        """Count one edit; `named` counts those whose finding says which file."""
        self.edits += 1
        self.noticed += bool(found)
        named = any(file in text for file in files for text in found)
        self.named += bool(found) and (named or not files)
        if not found:
            self.missed.append(what)
        elif files and not named:
            self.unnamed.append(f"{what}: {found[0]}")

    def result(self) -> dict[str, Any]:
        """The counts."""
        return vars(self) | {"unnamed": self.unnamed[:20]}


def every_leaf(run: Path, file: str, number: int, every: int, tally: Tally) -> None:
    """Change each leaf of one record, audit, put it back."""
    path = run / file
    whole = path.read_bytes()
    records = read(path)
    if spelled(path, records).encode() != whole:
        raise RuntimeError(
            f"{path} is not spelled as this benchmark spells it; the edits would be noticed by that alone"
        )
    paths = list(leaves(records[number]))[::every]
    print(f"{file}, record {number + 1}: {len(paths)} leaves", file=sys.stderr)
    for where in paths:
        edited = [*records[:number], copy.deepcopy(records[number]), *records[number + 1 :]]
        change_leaf(edited[number], where)
        path.write_text(spelled(path, edited), encoding="utf-8")
        tally.add(f"{file}, record {number + 1}: {'.'.join(map(str, where))}", findings(run), [file])
    path.write_bytes(whole)


# --- honest runs -----------------------------------------------------------------------------------------------------


def honest_runs(folder: Path, head: str) -> dict[str, list[str]]:
    """Name of each honest run -> violations found in it (none, if all is well)."""
    from trainers.estimators import ESTIMATORS

    found = {"edited below": findings(folder / "honest", head)}
    runs: dict[str, dict[str, Any]] = {
        f"estimator: {name}": {"estimator": name, **({"gamma": 0.9} if "gamma" in spec.needs else {})}
        for name, spec in ESTIMATORS.items()
    }
    for number, (name, changes) in enumerate({**runs, **HONEST}.items()):
        head = train(folder / f"honest-{number}", **{"max_steps": 1, **changes})
        found[name] = findings(folder / f"honest-{number}", head)
    return found


def train(folder: Path, *, faults: dict[tuple[int, int], str] | None = None, menu: bool = True, **changes: Any) -> str:
    """Train a tiny random model on the market; returns the head of the run's chain."""
    from datasets import Dataset

    from agentspec.files import file_digest
    from agentspec.types import Task
    from benchmarks.market import MARKET
    from benchmarks.resilience import Worlds
    from tests.tiny import tiny_model, tiny_tokenizer
    from trainers.config import ScaffoldConfig
    from trainers.grpo import ScaffoldGRPOTrainer
    from trainers.rollouts import task_rows

    settings: dict[str, Any] = {
        "output_dir": str(folder),
        "agent": {"reasoning": "direct", "sampling": {"max_tokens": 4}},
        "per_device_train_batch_size": 2,
        "gradient_accumulation_steps": 2,
        "num_generations": 2,
        "save_strategy": "no",
        "learning_rate": 1e-2,
        "report_to": [],
        "use_cpu": True,
        "bf16": False,
        "gradient_checkpointing": False,
        "logging_steps": 1,
        "disable_tqdm": True,
        "shuffle_dataset": False,
        **changes,
    }
    tokenizer = tiny_tokenizer()
    make = Worlds(faults or {})
    trainer = ScaffoldGRPOTrainer(
        tiny_model(tokenizer),
        ScaffoldConfig(**settings),
        train_dataset=Dataset.from_list(task_rows(_tasks(Task, MARKET, menu, 8, "train"))),
        eval_dataset=Dataset.from_list(task_rows(_tasks(Task, MARKET, menu, 1, "validation"))),
        processing_class=tokenizer,
        make_env=make,
    )
    trainer.train()
    return file_digest(folder / SEAL)


def _tasks(task: Callable[..., Any], env: str, menu: bool, count: int, split: str) -> list[Any]:
    first = 10_000 if split == "validation" else 0
    return [task(env, first + seed, {"steps": 2, "words": 2, "menu": menu}, split) for seed in range(count)]


if __name__ == "__main__":
    main()
