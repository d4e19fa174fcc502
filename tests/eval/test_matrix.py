"""The matrix on the toy environment: pairing, resuming, failures, one model at a time."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agentspec.episode import make_env
from agentspec.llm.scripted import ScriptedLLM
from agentspec.policies import Policy
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.tasks import task_sets
from agentspec.trajectory import read_trajectories
from agentspec.types import Task
from eval.matrix import evaluate
from eval.tables import markdown
from tests.toy_env import TOY

PLAIN = AgentSpec()
SCAFFOLDS = {"plain": PLAIN, "memory": AgentSpec.from_data({"memory": "base", "layout": "snapshot"})}
TASKS = [Task(TOY, seed) for seed in range(3)]
SELLER, WAITER = Policy("seller", "s"), Policy("waiter", "w")
SCRIPTS = {"seller": ["SELL()"], "waiter": ["WAIT()"]}


class Maker:
    """Makes scripted models and remembers whose."""

    def __init__(self) -> None:
        self.made: list[str] = []

    def __call__(self, policy: Policy) -> ScriptedLLM:
        self.made.append(policy.name)
        return ScriptedLLM(SCRIPTS[policy.name])


def play(out: Path, policies: Any = (SELLER, WAITER), specs: Any = None, tasks: Any = TASKS, **settings: Any) -> Any:
    maker = Maker()
    rows = evaluate(policies, specs or SCAFFOLDS, tasks, out=out, make_llm=maker, **settings)
    return rows, maker.made


def earned(rows: list[dict[str, Any]], **where: Any) -> list[float]:
    return [r["net_earnings"] for r in rows if all(r[k] == v for k, v in where.items())]


def test_every_policy_plays_every_scaffold_on_the_same_tasks(tmp_path: Path) -> None:
    rows, made = play(tmp_path)
    assert len(rows) == 2 * 2 * 3
    assert made == ["seller", "waiter"]  # one model each, shared by both scaffolds
    # The seller sells at all five prices of a task: what that pays depends on the task alone.
    expected = []
    for task in TASKS:
        env = make_env(task)
        env.reset(seed=task.seed)
        expected.append(float(sum(env.unwrapped.prices[:5])))
    assert earned(rows, policy="seller", scaffold="plain") == expected
    assert earned(rows, policy="seller", scaffold="memory") == expected
    assert earned(rows, policy="waiter") == [0.0] * 6
    assert [r["seed"] for r in rows] == [0, 1, 2] * 4
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 12


def test_a_finished_evaluation_loads_no_model(tmp_path: Path) -> None:
    rows, _ = play(tmp_path)
    again, made = play(tmp_path)
    assert again == rows and made == []


def test_a_stopped_evaluation_goes_on_where_it_was(tmp_path: Path) -> None:
    rows, _ = play(tmp_path)
    path = tmp_path / "results.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:7]) + lines[7][:40])  # seven whole lines and a torn one
    again, made = play(tmp_path)
    assert made == ["waiter"]  # the seller's six were done
    assert [{**r, "thinking_s": 0, "thinking_s_per_step": 0} for r in again] == [
        {**r, "thinking_s": 0, "thinking_s_per_step": 0} for r in rows
    ]
    assert [json.loads(line)["policy"] for line in path.read_text().splitlines()] == ["seller"] * 6 + ["waiter"] * 6


def test_more_tasks_and_rollouts_are_added_to_what_is_there(tmp_path: Path) -> None:
    play(tmp_path, policies=[SELLER])
    rows, _ = play(tmp_path, policies=[SELLER, WAITER], tasks=[*TASKS, Task(TOY, 9)], rollouts=2)
    assert len(rows) == 2 * 2 * 4 * 2


def test_results_of_another_configuration_are_refused(tmp_path: Path) -> None:
    play(tmp_path, policies=[SELLER], specs={"plain": PLAIN})
    for changes in ({"specs": {"plain": SCAFFOLDS["memory"]}}, {"sampling": {"temperature": 0.5}}, {"seed": 1}):
        with pytest.raises(SpecError, match=r"another configuration.*choose another"):
            play(tmp_path, **{"policies": [SELLER], "specs": {"plain": PLAIN}} | changes)


def test_stale_results_can_be_replaced(tmp_path: Path) -> None:
    out = tmp_path / "evaluation.jsonl"
    play(out, specs={"plain": PLAIN})
    changed = {"plain": SCAFFOLDS["memory"]}
    rows, made = play(out, specs=changed, replace_stale=True)
    assert made == ["seller", "waiter"] and len(rows) == len(out.read_text().splitlines()) == 6
    assert play(out, specs=changed) == (rows, [])


def test_failed_episodes_are_rows_and_can_be_retried(tmp_path: Path) -> None:
    tasks = {"fair": TASKS[:1], "broken": [Task(TOY, 5, {"fault": "crash"})]}
    rows, _ = play(tmp_path, policies=[SELLER], specs={"plain": PLAIN}, tasks=tasks)
    assert [r["status"] for r in rows] == ["completed", "failed"] and "the toy broke" in rows[1]["error"]
    assert [r["tasks"] for r in rows] == ["fair", "broken"]
    assert play(tmp_path, policies=[SELLER], specs={"plain": PLAIN}, tasks=tasks)[1] == []
    again, made = play(tmp_path, policies=[SELLER], specs={"plain": PLAIN}, tasks=tasks, retry_failed=True)
    assert made == ["seller"] and len(again) == 2
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 2  # one line per cell


def test_evaluation_is_greedy_unless_told_otherwise(tmp_path: Path) -> None:
    play(tmp_path / "a", policies=[SELLER], specs={"plain": PLAIN}, trajectories=True)
    play(tmp_path / "b", policies=[SELLER], specs={"plain": PLAIN}, trajectories=True, sampling={"temperature": 0.7})
    for folder, temperature in (("a", 0.0), ("b", 0.7)):
        paths = sorted((tmp_path / folder / "trajectories/seller/plain").iterdir())
        assert len(paths) == 3
        [trajectory] = read_trajectories(paths[0])
        assert {c.sampling.temperature for c in trajectory.calls} == {temperature}


def test_memory_of_a_run_is_carried_from_episode_to_episode(tmp_path: Path) -> None:
    spec = {"m": replace(SCAFFOLDS["memory"], scope="run")}
    rows, _ = play(tmp_path, policies=[SELLER], specs=spec, trajectories=True)
    assert [r["status"] for r in rows] == ["completed"] * 3
    path = tmp_path / "results.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:2]))
    events: list[int] = []
    evaluate([SELLER], spec, TASKS, out=tmp_path, make_llm=Maker(), on_row=lambda row: events.append(row["seed"]))
    # One cell was missing, but memory that runs on starts at the first episode: all three are played, in order.
    assert events == [0, 1, 2] and len(path.read_text().splitlines()) == 3


def test_what_cannot_work_is_refused_before_anything_is_played(tmp_path: Path) -> None:
    cases: list[tuple[Callable[[], Any], str]] = [
        (lambda: play(tmp_path, policies=[SELLER, SELLER]), "two policies are called seller"),
        (lambda: play(tmp_path, policies=[]), "nothing to evaluate"),
        (lambda: play(tmp_path, tasks=[]), "no tasks"),
        (lambda: play(tmp_path, tasks=[TASKS[0], TASKS[0]]), "given twice"),
        (lambda: play(tmp_path, tasks=[Task("deliverybnch", 0)]), "did you mean deliverybench"),
        (lambda: play(tmp_path, sampling={"temprature": 1}), "did you mean temperature"),
        (lambda: play(tmp_path, tasks=[Task(TOY, 0, {"nonsense": 1})]), "refused its options"),
    ]
    for attempt, message in cases:
        with pytest.raises(SpecError, match=message):
            attempt()
    assert not list(tmp_path.iterdir())


def test_any_environment_of_gymnasium_is_evaluated(tmp_path: Path) -> None:
    tasks = [Task("CartPole-v1", seed) for seed in range(2)]
    rows = evaluate([Policy("random")], {"plain": PLAIN}, tasks, out=tmp_path)
    assert [row["return"] for row in rows] == [row["steps"] for row in rows]  # a point for every step
    text = markdown(rows)
    assert "## CartPole-v1: return" in text and "| random |" in text and "profit" not in text


def test_tasks_are_split_by_environment_and_options() -> None:
    assert list(task_sets(TASKS)) == [TOY]
    menu = [Task(TOY, seed, {"menu": True}) for seed in range(2)]
    assert {k: len(v) for k, v in task_sets([*TASKS, *menu]).items()} == {TOY: 3, f"{TOY} menu=True": 2}


def test_a_broken_results_file_is_named_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "results.jsonl").write_text('{"policy": "x"}\n')
    with pytest.raises(ValueError, match=r"results\.jsonl, line 1"):
        play(tmp_path)
