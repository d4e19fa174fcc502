"""The evaluation of a study: the matrix of its policies and scaffolds, and what the report must know of the rest."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agentspec.files import append_lines, write_atomic
from agentspec.policies import Policy
from agentspec.records.folder import trained_on
from agentspec.tasks import make_tasks, unseen_tasks
from agentspec.types import Task
from eval.live import LiveTable
from eval.matrix import evaluate
from eval.report import build_report, write_files
from eval.report.training import COSTS, FILE
from eval.study.plan import Study


def held_out(count: int, trained: Sequence[Any]) -> dict[str, list[Task]]:
    """The tasks that all policies play: different episodes on which nobody is trained, in the world of the first.

    Args:
        trained: training configurations (`world`, `train_tasks`, `adapter`) of all arms and of their start; what an
            adapter that is a run's folder was trained on is told by its manifest.

    Raises:
        SpecError: the world has too few.
    """
    worlds = {str(w): w for c in trained for w in ((*c.world, c.train_tasks), *trained_on(c.adapter))}
    seen = [task for name, options, number in worlds.values() for task in make_tasks(name, options, number)]
    name, options = trained[0].world
    return {name: unseen_tasks(name, options, count, seen)}


def play(study: Study, policies: Sequence[Policy], tasks: Mapping[str, Sequence[Task]]) -> None:
    """Play what is not in the store; what it took, in CPU seconds of all threads, is a line of `costs.jsonl`."""
    out, before = Path(study.out), os.times()
    evaluate(policies, study.scaffolds, tasks, out=out, settings=study.settings, twins=True, observer=LiveTable())
    after = os.times()
    spent = after.user + after.system - before.user - before.system
    append_lines(out / COSTS, {"what": "evaluation", "cpu_s": round(spent, 1)})


def conclude(study: Study, rollouts: Mapping[str, int], audits: Mapping[tuple[str, int], Any]) -> list[Path]:
    """Write `study.json` and the report.

    Args:
        rollouts, audits: see `Study.record`.

    Returns:
        the files of the report.
    """
    out = Path(study.out)
    write_atomic(out / FILE, study.record(rollouts, audits))
    return write_files(build_report(out, title=out.name), out / "report")
