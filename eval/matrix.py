"""The matrix: every policy plays every scaffold on the same tasks.

Which scaffold, trained how, for which task? The answer is a table whose cells must be comparable: all policies and
scaffolds get identical tasks (environment, options and seed) and identical seeds of their own draws. Finished episodes
are kept in a store (`eval.store`) from which any matrix takes what it needs, so a stopped evaluation goes on where it
was and a larger one plays only what is new. One model is in memory at a time and serves all of its scaffolds.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from agentspec.actions import suggest
from agentspec.episode import MakeEnv, make_env
from agentspec.files import json_line, write_lines
from agentspec.llm.local.release import release
from agentspec.policies import Policy
from agentspec.progress import load_policy
from agentspec.registry import SpecError
from agentspec.spec import MODULE_KINDS, AgentSpec
from agentspec.tasks import Tasks, task_sets
from agentspec.types import Task
from eval.cells import Cell, CellName, Planned, Settings, plan_cell
from eval.play import LocalPlayer, MakeLLM, Play, Player
from eval.store import Record, Store

RESULTS = "results.jsonl"
UNPLAYED = "unplayed"
"""Status of a row whose episode was not played: its cell's limit was reached, or the cell could not be played."""

OnRow = Callable[[dict[str, Any]], None]


class Observer:
    """Told how an evaluation goes; does nothing."""

    def planned(self, cells: Sequence[Cell], store: Store) -> None:
        """All cells, before anything is played."""

    def finished(self, cell: Cell, planned: Planned, record: Record) -> None:
        """An episode was added to the store."""

    def failed(self, cells: Sequence[Cell], why: str) -> None:
        """These cells cannot be played (any further)."""

    def close(self) -> None:
        """The evaluation has ended."""


def evaluate(
    policies: Sequence[Policy],
    specs: Mapping[str, AgentSpec],
    tasks: Tasks,
    *,
    out: str | Path,
    store: str | Path = "",
    settings: Settings | None = None,
    make_llm: MakeLLM | None = None,
    make_env: MakeEnv = make_env,
    executor: str = "local",
    workers: int = 1,
    address: str = "",
    twins: bool = False,
    on_row: OnRow | None = None,
    observer: Observer | None = None,
    **changes: Any,
) -> list[dict[str, Any]]:
    """Play policies x scaffolds x tasks and return one row per episode (see `agentspec.metrics.episode_row`).

    A cell that cannot be played (a backend that breaks down, a scaffold that it cannot serve) stops no other: its rows
    have the status `unplayed` and say why, and so have those that a limit left out.

    Args:
        policies: rows of the matrix; pairs of name and training run must differ.
        specs: scaffold by label: columns of the matrix.
        tasks: tasks, or several labelled sets of them (one table each); no task may stand in two sets.
        out: folder of `results.jsonl`, the rows of this matrix as it stands now.
        store: folder of finished episodes; default: `out`. Several matrices may share one.
        settings: how to play; keyword arguments `changes` are fields of it that replace its own.
        make_llm: policy -> loaded backend; default: what the policy says. Called once per policy that has to play.
        make_env: task -> environment.
        executor: `local`, or `ray`: `workers` processes, here or on the cluster at `address`, with one model each.
        twins: training runs of a policy may have the same weights (they have learnt nothing); else that is refused,
            since who lists one run twice would count it as two.
        on_row: told of every episode that is played now.
        observer: told of more.

    Raises:
        SpecError: names that clash, another evaluation writing into the same store.
        ModelNotFoundError: a policy's model does not exist. As any error of making an environment (an unknown name, a
            map that is not there), it is raised before anything is played.
    """
    settings = replace(settings or Settings(), **changes)
    sets = task_sets(tasks)
    _check(policies, specs, settings, executor, twins)
    if executor != "ray" and (workers != 1 or address):
        raise SpecError("workers and address are those of Ray: give executor: ray (--executor ray), or leave them out")
    seen = observer or Observer()
    kept = Store(store or out, settings.prices)
    rows_of = [[plan_cell(p, label, spec, sets, settings, kept) for label, spec in specs.items()] for p in policies]
    cells = [cell for row in rows_of for cell in row]
    missing = {cell.name: _missing(cell, kept, settings) for cell in cells}
    _check_first([row for row in rows_of if any(missing[c.name] for c in row)], sets, make_llm, make_env)
    with kept.writing():
        missing = {cell.name: _missing(cell, kept, settings) for cell in cells}
        playing = [[cell for cell in row if missing[cell.name]] for row in rows_of]
        seen.planned(cells, kept)
        problems: dict[CellName, str] = {}

        def told(cell: Cell, planned: Planned, record: Record) -> None:
            seen.finished(cell, planned, record)
            if on_row:
                on_row(row_of(cell, planned, record))

        try:
            for row in filter(None, playing):
                fresh = {key for cell in row for key in missing[cell.name] if key and kept.get(key)}
                play = Play(kept, settings, told, fresh)
                for cell, why in _play_policy(row, play, make_llm, make_env, executor, workers, address):
                    problems[cell.name] = why
                    seen.failed([cell], why)
        finally:
            seen.close()
            rows = [row for cell in cells for row in rows_of_cell(cell, kept, settings, problems.get(cell.name, ""))]
            rows = [_from(Path(out), kept.folder, row) for row in rows]
            write_lines(Path(out) / RESULTS, rows)
    return rows


def kept_episodes(
    policies: Sequence[Policy], specs: Mapping[str, AgentSpec], tasks: Tasks, settings: Settings, store: str | Path
) -> int:
    """How many episodes of a matrix a store has already; failures count."""
    sets, kept = task_sets(tasks), Store(store)
    cells = [plan_cell(p, label, spec, sets, settings, kept) for p in policies for label, spec in specs.items()]
    return sum(record is not None for cell in cells for chain in cell.chains for _, record, _ in cell.walk(kept, chain))


def _from(out: Path, store: Path, row: dict[str, Any]) -> dict[str, Any]:
    """The row with the path of its trajectory as it is found from `out`."""
    if not row.get("trajectory") or out.resolve() == store.resolve():
        return row
    return row | {"trajectory": os.path.relpath(store / row["trajectory"], out)}


def _play_policy(
    cells: Sequence[Cell],
    play: Play,
    make_llm: MakeLLM | None,
    make_env: MakeEnv,
    executor: str,
    workers: int,
    address: str,
) -> list[tuple[Cell, str]]:
    """Play the cells of one policy; returns those that broke down, and why."""
    policy, settings = cells[0].policy, play.settings
    problems: list[tuple[Cell, str]] = []

    async def each(player: Player, at_once: int | None) -> None:
        gate = asyncio.Semaphore(at_once or sum(len(cell.chains) for cell in cells))
        results = await asyncio.gather(*(play.cell(cell, player, gate) for cell in cells), return_exceptions=True)
        for cell, result in zip(cells, results, strict=True):
            if isinstance(result, BaseException):
                problems.append((cell, _reason(result)))

    try:
        if executor == "ray":
            from eval.ray_player import RayPlayer

            with RayPlayer(policy, settings, workers, address, make_llm, make_env) as ray:
                asyncio.run(each(ray, settings.concurrency and settings.concurrency * workers))
        else:
            llm = (make_llm or load_policy)(policy)
            asyncio.run(each(LocalPlayer(llm, settings, make_env), settings.concurrency))
            del llm
            release()  # the next model needs the memory now, not when the collector gets to the cycles
    except Exception as error:
        return [(cell, _reason(error)) for cell in cells]
    return problems


def _reason(error: BaseException) -> str:
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    if not isinstance(error, Exception):
        raise error  # Ctrl-C is nobody's failure
    return f"{type(error).__name__}: {error}"


def rows_of_cell(cell: Cell, store: Store, settings: Settings, problem: str = "") -> list[dict[str, Any]]:
    """The rows of a cell as the store has them; episodes that it lacks have the status `unplayed` and a reason."""
    by_episode: dict[tuple[str, int], dict[str, Any]] = {}
    records: list[Record] = []
    for chain in cell.chains:
        found = {}
        for planned, record, _ in cell.walk(store, chain):
            if record is not None:
                found[id(planned)] = record
                records.append(record)
        for planned in chain:
            by_episode[planned.job.task.key, planned.job.rollout] = row_of(cell, planned, found.get(id(planned)))
    rows = sorted(by_episode.values(), key=lambda row: row["rollout"])
    order = {task: i for i, task in enumerate(dict.fromkeys(row["task"] for row in rows))}
    rows.sort(key=lambda row: (order[row["task"]], row["rollout"]))
    reason = problem or settings.limits.spent(records) or "the evaluation was stopped"
    return [row | {"error": reason} if row["status"] == UNPLAYED else row for row in rows]


def row_of(cell: Cell, planned: Planned, record: Record | None) -> dict[str, Any]:
    """A row of results: names of the cell, then the episode."""
    policy, run, scaffold = cell.name
    names = {"policy": policy, "run": run, "scaffold": scaffold, "tasks": planned.tasks, "agent": agent_of(cell.spec)}
    task = planned.job.task
    if record is None:
        unplayed = {"env": task.env, "task": task.key, "seed": task.seed, "options": dict(task.options)}
        return names | unplayed | {"rollout": planned.job.rollout, "status": UNPLAYED, "error": "", "ended": ""}
    kept = {name: record[name] for name in ("key", "configuration", "wall_s", "trajectory") if name in record}
    return names | kept | record["episode"]


def agent_of(spec: AgentSpec) -> dict[str, str]:
    """What an agent is made of, by name."""
    modules = {kind: getattr(spec, kind).name for kind in MODULE_KINDS}
    return modules | {"layout": spec.layout, "scope": spec.scope}


def _missing(cell: Cell, store: Store, settings: Settings) -> list[str]:
    """Keys of the episodes that are to be played as far as they can be named (a chain's later ones cannot)."""
    keys = []
    for chain in cell.chains:
        for planned, record, memory in cell.walk(store, chain):
            failed = record is not None and record["episode"]["status"] == "failed"
            if record is None or (failed and settings.retry_failed):
                keys.append(cell.key(planned.job, memory))
    return keys


def _check(
    policies: Sequence[Policy], specs: Mapping[str, AgentSpec], settings: Settings, executor: str, twins: bool
) -> None:
    if executor not in ("local", "ray"):
        raise SpecError(f"unknown executor {executor!r}{suggest(executor, ('local', 'ray'))}")
    if not policies or not specs:
        got = f"{len(policies)} policies and {len(specs)} scaffolds"
        raise SpecError(f"nothing to evaluate: got {got}; give at least one of each")
    names = [(p.name, p.run) for p in policies]
    twice = sorted({name for name, run in names if names.count((name, run)) > 1})
    if twice:
        raise SpecError(f"two policies are called {', '.join(twice)}; give each its own name (NAME=MODEL)")
    for policy in () if twins else dict.fromkeys(name for name, _ in names):
        same = [p for p in policies if p.name == policy]
        if len({json_line(p.identity()) for p in same}) < len(same):
            runs = ", ".join(p.run for p in same)
            raise SpecError(f"policy {policy!r}: two of its training runs ({runs}) have the same weights and settings")
    if settings.start_memory and not any(spec.scope == "run" for spec in specs.values()):
        raise SpecError("start_memory is given, but no scaffold has `scope: run`: every episode would start empty")
    if isinstance(settings.start_memory, Mapping):
        for name in settings.start_memory:
            if name not in (known := [p.name for p in policies]):
                raise SpecError(f"start_memory names the policy {name!r}{suggest(name, known)}")


def _check_first(
    playing: Sequence[Sequence[Cell]],
    sets: Mapping[str, Sequence[Task]],
    make_llm: MakeLLM | None,
    make_env: MakeEnv,
) -> None:
    """Find every model and make one environment of each kind: what is missing shows before hours of work, not after."""
    if not playing:
        return
    if make_llm is None:
        for row in playing:
            row[0].policy.check()
    for task in {replace(t, seed=0).key: t for members in sets.values() for t in members}.values():
        make_env(task).close()


__all__ = ["Observer", "Policy", "Settings", "Task", "evaluate", "rows_of_cell"]
