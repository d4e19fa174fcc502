"""Evaluation with `scope: run`: memory stays within a set of tasks, rows belong to an order, a start is taken up."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agentspec.carry import FILE, MemoryBank, run_in_order, save_bank
from agentspec.episode import Job, Runner
from agentspec.llm.scripted import ScriptedLLM
from agentspec.policies import Policy
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from eval.matrix import evaluate
from tests.test_carry import SPEC, Idler
from tests.toy_env import TOY

TASKS = [Task(TOY, seed) for seed in range(3)]
MENU = [Task(TOY, seed, {"menu": True}) for seed in (0, 1)]


def play(out: Path, tasks: Any, spec: AgentSpec = SPEC, **settings: Any) -> tuple[list[dict[str, Any]], Idler]:
    idler = Idler()

    def script(request: Any) -> str:
        text = idler(request)
        return "wait a step" if request.sampling.choices and text == "WAIT()" else text

    rows = evaluate(
        [Policy("idler", "x")], {"s": spec}, tasks, out=out, make_llm=lambda _: ScriptedLLM(script), **settings
    )
    return rows, idler


def test_memory_does_not_run_from_one_set_into_the_next(tmp_path: Path) -> None:
    # Lessons are kept per world, options and all; the same options in two sets would show a leak.
    sets = {"first": TASKS[:2], "second": [Task(TOY, seed) for seed in (5, 6)]}
    _, idler = play(tmp_path, sets, rollouts=2)
    # Each of four chains (two sets, two rollouts) starts empty; its second episode sees its own first lesson only.
    assert sorted(idler.seen) == [[], [], [], [], *([n] for n in sorted(seen[0] for seen in idler.seen if seen))]
    assert len({tuple(seen) for seen in idler.seen}) == 5


def test_reordered_tasks_do_not_return_old_rows(tmp_path: Path) -> None:
    rows, _ = play(tmp_path, TASKS)
    assert play(tmp_path, TASKS)[0] == rows
    again, idler = play(tmp_path, [TASKS[1], TASKS[0], TASKS[2]])
    # The third starts from the very memory that it started from before, to the byte: it is kept.
    assert [r["seed"] for r in again] == [1, 0, 2] and idler.seen == [[], [1]]
    assert play(tmp_path, TASKS)[0] == rows
    # Without memory over episodes the order of tasks says nothing.
    plain = AgentSpec.from_data({"reasoning": "direct"})
    play(tmp_path / "plain", TASKS, plain)
    assert play(tmp_path / "plain", TASKS[::-1], plain)[1].acts == {}


def test_tasks_added_at_the_end_leave_other_chains_alone(tmp_path: Path) -> None:
    play(tmp_path, {"a": TASKS[:2], "b": MENU})
    rows, idler = play(tmp_path, {"a": TASKS, "b": MENU})
    assert (
        len(rows) == 5 and len(idler.seen) == 1 and len(idler.seen[0]) == 2
    )  # the longer chain goes on, the other is not played at all


def test_a_memory_grown_elsewhere_is_evaluated(tmp_path: Path) -> None:
    _, bank = run_in_order(Runner(SPEC, ScriptedLLM(Idler())), [Job(Task(TOY, 90)), Job(Task(TOY, 91))])
    save_bank(tmp_path / "run" / FILE, bank)
    _, idler = play(tmp_path / "grown", {"a": TASKS[:1], "b": TASKS[1:2]}, start_memory=str(tmp_path / "run"))
    assert idler.seen == [[1, 2], [1, 2]]  # every chain starts from it
    # A scripted policy beside it has no use for a memory, and does not stop the evaluation.
    evaluate([Policy("random")], {"s": SPEC}, MENU, out=tmp_path / "random", start_memory=str(tmp_path / "run"))
    # The same model with and without it, side by side.
    seen: dict[str, Idler] = {"with": Idler(), "without": Idler()}
    evaluate(
        [Policy("with", "x"), Policy("without", "x")],
        {"s": SPEC},
        TASKS[:1],
        out=tmp_path / "both",
        make_llm=lambda policy: ScriptedLLM(seen[policy.name]),
        start_memory={"with": str(tmp_path / "run")},
    )
    assert (seen["with"].seen, seen["without"].seen) == ([[1, 2]], [[]])
    with pytest.raises(SpecError, match="did you mean idler"):
        play(tmp_path / "misnamed", TASKS, start_memory={"idle": str(tmp_path / "run")})
    # It is part of what rows depend on.
    save_bank(tmp_path / "run" / FILE, MemoryBank.of_spec(SPEC))
    _, idler = play(tmp_path / "grown", {"a": TASKS[:1], "b": TASKS[1:2]}, start_memory=str(tmp_path / "run"))
    assert idler.seen == [[], []]
    with pytest.raises(SpecError, match="no scaffold has `scope: run`"):
        play(tmp_path / "none", TASKS, AgentSpec(), start_memory=str(tmp_path / "run"))
