"""What to play: tasks by split, and labelled sets of them.

Shared by training, evaluation and the command line. Splits are ranges of seeds: where every seed starts another
episode, a policy is never tested on what it was trained on. A finite suite or a small level repeats its episodes,
whatever the split: `episode_key` tells them apart, `unseen_tasks` leaves out what was trained on.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from agentspec.envs.making import environment_class, short_names
from agentspec.registry import SpecError
from agentspec.types import Task

SPLITS = {"train": 0, "validation": 10_000, "test": 20_000}
"""Split -> its first seed."""

TEST_SEEDS = SPLITS["test"]
"""Held-out tasks start at this seed; training tasks stay below 10,000 (validation lies between)."""

Tasks = Sequence[Task] | Mapping[str, Sequence[Task]]
"""Tasks to split by environment and options, or labelled sets of them."""


def make_tasks(env: str, options: dict[str, Any], count: int, *, split: str = "train", first: int = 0) -> list[Task]:
    """`count` tasks of one environment with consecutive seeds, from the `first`-th of the split on.

    Raises:
        ValueError: an unknown split, or training seeds that reach into the held-out range.
    """
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; expected one of {', '.join(SPLITS)}")
    base = SPLITS[split] + first
    if split == "train" and base + count > SPLITS["validation"]:
        raise ValueError(f"training seeds {base}..{base + count - 1} reach the held-out range; use fewer than 10,000")
    return [Task(env, base + i, options, split) for i in range(count)]


def episode_key(task: Task) -> Hashable:
    """The same for tasks that start the same episode.

    The environment names its episodes (`episode_key` in `agentspec.envs.contract`); where it does not, every seed is
    one of its own.

    Raises:
        SpecError: options that the environment does not take.
    """
    named = getattr(environment_class(task.env), "episode_key", None)
    if named is None:
        return replace(task, split="").key
    try:
        return environment_name(task.env), named(task.options, task.seed)
    except ValueError as error:
        raise SpecError(f"env {task.env!r}: {error}") from error


PATIENCE = 1000
"""Seeds in a row without an episode that was not met before, after which a world is taken to have no more."""


def unseen_tasks(
    env: str, options: dict[str, Any], count: int, trained: Iterable[Task], *, split: str = "test"
) -> list[Task]:
    """The first `count` tasks of a split that are different episodes, none of them one of `trained`.

    Raises:
        SpecError: there are not that many.
    """
    seen = {episode_key(task) for task in trained}
    found: list[Task] = []
    last = 0
    for number, task in enumerate(make_tasks(env, options, SPLITS["validation"], split=split)):
        if len(found) == count or number - last > PATIENCE:
            break
        if (key := episode_key(task)) not in seen:
            seen.add(key)
            found.append(task)
            last = number
    if len(found) < count:
        raise SpecError(
            f"got {count} tasks, expected at most {len(found)}: {environment_name(env)} with {options} has no more "
            f"episodes in its {split} split that are not trained on; ask for fewer, or train on fewer (`train_tasks`)"
        )
    return found


def task_sets(tasks: Tasks) -> dict[str, list[Task]]:
    """Labelled sets of tasks; a plain sequence is split by environment and options.

    Raises:
        SpecError: no task at all, or one task given twice.
    """
    if isinstance(tasks, Mapping):
        sets = {label: list(members) for label, members in tasks.items()}
    else:
        groups: dict[str, list[Task]] = {}
        for task in tasks:
            groups.setdefault(replace(task, seed=0).key, []).append(task)
        sets = {}
        names = [environment_name(members[0].env) for members in groups.values()]
        for name, members in zip(names, groups.values(), strict=True):
            options = " ".join(f"{k}={v}" for k, v in members[0].options.items()) if names.count(name) > 1 else ""
            label = f"{name} {options}".strip()
            sets[label if label not in sets else f"{label} ({members[0].split})"] = members
    keys = [task.key for members in sets.values() for task in members]
    if not keys or len(set(keys)) < len(keys):
        problem = "no tasks" if not keys else f"{len(keys) - len(set(keys))} of {len(keys)} tasks are given twice"
        raise SpecError(f"{problem}; give each task (environment, options, seed) exactly once")
    return sets


def environment_name(env: str) -> str:
    """The registered short name of an environment, or its id."""
    return next((name for name, target in short_names().items() if target == env), env)


def parse_seeds(texts: Sequence[str]) -> list[int]:
    """``0-3``, ``0,1,2`` or several of these, as a list of seeds without repeats.

    Raises:
        SpecError: not of that form.
    """
    seeds: list[int] = []
    for part in ",".join(texts).split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdigit() or (dash and not last.isdigit()):
            raise SpecError(f"seeds {part!r}: expected numbers and ranges such as 0-15 or 0,4,8")
        seeds += range(int(first), int(last or first) + 1)
    if not seeds:
        raise SpecError(f"seeds {' '.join(texts)!r} name no seed: a range counts upwards, such as 0-15")
    return list(dict.fromkeys(seeds))
