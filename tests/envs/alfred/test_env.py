"""The ALFRED environment: contract, every task type by our expert, metrics, budgets, snapshots."""

from __future__ import annotations

import random

import pytest

from agentspec.envs import check_environment
from agentspec.envs.alfred.env import AlfredEnv
from agentspec.envs.alfred.expert import Expert, luck
from agentspec.envs.alfred.own import TASKS
from agentspec.envs.alfred.trials import TYPES
from agentspec.types import Task
from tests.envs.thor.household import TRIALS, needs_data


def play(seed: int, **options):
    env = AlfredEnv(**options)
    _, info = env.reset(seed=seed)
    player, total, ended = Expert(options), 0.0, False
    while not ended:
        _, reward, terminated, truncated, info = env.step(player.act(info))
        assert not info["invalid"], info["error"]
        total, ended = total + reward, terminated or truncated
    return env, info, total


@pytest.mark.parametrize(
    "options", [{"max_steps": 9}, {"max_steps": 9, "action_mode": "menu", "images": True}], ids=str
)
@pytest.mark.parametrize("seed", [0, 5])
def test_the_contract_holds(options, seed):
    check_environment(Task("alfred", seed, options), seed=seed)


@needs_data
def test_the_contract_holds_for_the_paper_tasks():
    check_environment(Task("alfred", 0, {"suite": "paper", "data": TRIALS, "max_steps": 9}))


def test_our_tasks_cover_every_type_with_slicing_too():
    assert {task[0] for task in TASKS} == set(TYPES)
    assert {task[0] for task in TASKS if task[2].sliced} >= set(TYPES) - {"look_at_obj_in_light"}


@pytest.mark.parametrize("seed", range(len(TASKS)))
@pytest.mark.parametrize("mode", ["native", "menu"])
def test_the_expert_achieves_every_task(seed, mode):
    _, info, total = play(seed, action_mode=mode)
    assert info["success"] and info["metrics"]["goal_conditions"] == 1.0
    assert total == pytest.approx(1.0) and info["metrics"]["spl"] > 0.5


@needs_data
@pytest.mark.parametrize("task", range(7))
@pytest.mark.parametrize("mode", ["native", "menu"])
def test_the_expert_achieves_the_paper_tasks(task, mode):
    _, info, _ = play(task, suite="paper", data=TRIALS, trial=1, action_mode=mode)
    assert info["success"] and info["metrics"]["primitive_steps"] <= 200


def test_go_to_costs_as_many_steps_as_the_way_has():
    env = AlfredEnv(action_mode="menu")
    _, info = env.reset(seed=0)
    way = next(c for c in info["action_schema"].choices if c.startswith("go to"))
    *_, info = env.step(way)
    moved = int(info["message"].rpartition(", ")[2].split()[0])
    assert info["metrics"]["primitive_steps"] == moved > 0


def test_stopping_at_once_fails_and_keeps_the_figures_apart():
    env = AlfredEnv()
    env.reset(seed=2)
    *_, terminated, _, info = env.step("STOP()")
    metrics = info["metrics"]
    assert terminated and (metrics["success"], metrics["spl"]) == (0.0, 0.0)
    assert (metrics["goal_conditions_met"], metrics["goal_conditions_total"]) == (0, 3)


def test_success_on_the_last_step_is_a_success():
    steps = play(0)[0].steps
    _, info, _ = play(0, max_steps=steps)
    assert info["success"]
    *_, info, _ = play(0, max_steps=steps - 1)
    assert not info["success"]


def test_snapshots_are_identities_under_random_play():
    env, twin = AlfredEnv(action_mode="menu"), AlfredEnv(action_mode="menu")
    _, info = env.reset(seed=7)
    twin.reset(seed=3)
    player = luck({}, random.Random(1))
    for _ in range(15):
        blob = env.snapshot()
        twin.restore(blob)
        assert twin.snapshot() == blob
        text = player.act(info)
        mine, theirs = env.step(text), twin.step(text)
        assert mine[0] == theirs[0] and mine[1:4] == theirs[1:4]
        info = mine[4]
        if mine[2] or mine[3]:
            break


def test_data_must_be_named_for_the_paper_tasks():
    with pytest.raises(ValueError, match="data is empty"):
        AlfredEnv(suite="paper")
