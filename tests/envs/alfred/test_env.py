"""The ALFRED environment: contract, every task type by our expert, metrics, budgets, snapshots."""

from __future__ import annotations

import random

import gymnasium
import pytest

from agentspec.envs import check_environment
from agentspec.envs.alfred.env import RULES, AlfredEnv
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": 16}, "task is 16; expected -1 to 15"),
        ({"task": -2}, "task is -2"),
        ({"trial": 1}, "trial is 1; expected 0"),
        ({"annotation": 1}, "annotation is 1; expected 0"),
        ({"data": "."}, "the suite `own` reads no data"),
        ({"suite": "paper", "data": "nowhere"}, "data is 'nowhere': there is no such folder"),
        ({"suite": "paper", "data": ".", "objects": "nowhere"}, "objects is 'nowhere'"),
        ({"suite": "paper", "data": ".", "task": 7}, "task is 7; expected -1 to 6"),
        ({"suite": "paper", "data": ".", "trial": 3}, "trial is 3; expected 0 to 2"),
        ({"suite": "paper", "data": ".", "trial": -3}, "trial is -3"),
        ({"suite": "paper", "data": ".", "annotation": -1}, "annotation is -1; expected at least 0"),
        ({"trial_file": "x.json", "data": ".", "task": 3}, "task is 3; expected -1"),
    ],
)
def test_options_out_of_range_or_without_effect_are_refused(options, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        AlfredEnv(**options)


@needs_data
def test_an_instruction_that_nobody_wrote_is_refused():
    with pytest.raises(ValueError, match=r"annotation is 77; .* has 0 to"):
        AlfredEnv(suite="paper", data=TRIALS, annotation=77).reset(seed=0)


def test_the_menu_does_not_depend_on_what_was_looked_up_before():
    """What lies in a bowl can be gone to until the bowl is taken; a cache that forgets the hand kept the way."""
    env, twin = AlfredEnv(action_mode="menu"), AlfredEnv(action_mode="menu")
    env.reset(seed=2)
    bodies = env.world.boxes().state.bodies
    bowl, spoon = (next(b for b in bodies.values() if b.type == name) for name in ("Bowl", "Spoon"))
    spoon.move(bowl.centre)
    spoon.parents = [bowl.id, *bowl.parents]
    env.world.boxes().touched()
    env._look(env.world.observe())
    env.known.add(spoon.id)
    record = next(o for o in env.event.metadata["objects"] if o["objectId"] == spoon.id)
    assert env.reachable(record)
    bowl.held = True
    bowl.parents, spoon.parents = [], [bowl.id]
    env.world.boxes().touched()
    env._look(env.world.observe())
    twin.restore(env.snapshot())
    assert env._schema().choices == twin.offered
    assert f"go to {env.names.name(spoon.id)}" not in twin.offered


def test_before_the_first_reset_it_is_said_that_there_is_no_episode():
    env = AlfredEnv(render_mode="rgb_array")
    for call in (env.observe, env.snapshot, env.render, lambda: env.step("STOP()")):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()


@pytest.mark.parametrize("blob", [b"", b"[]", b"{}", b"\xff"])
def test_bytes_that_are_no_snapshot_are_refused(blob):
    env = AlfredEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="no snapshot of AlfredEnv"):
        env.restore(blob)


def test_what_is_in_a_drawer_is_not_on_the_counter_above():
    env = AlfredEnv()
    for seed in (35, 47):  # a tomato below the counter it should go to, a CD in a drawer of the desk
        _, info = env.reset(seed=seed)
        assert info["metrics"]["goal_conditions_met"] == 0
    wanted = [o for o in env.event.metadata["objects"] if o["objectType"] == "CD"]
    assert ["Drawer"] in [[p.split("|")[0] for p in o["parentReceptacles"] or ()] for o in wanted]


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({}, None),
        ({"task": 1}, 1),
        ({"suite": "paper"}, 7),
        ({"suite": "paper", "task": 2}, 1),
        ({"trial_file": ""}, None),
        ({"trial_file": "a.json"}, 1),
    ],
)
def test_how_many_episodes_there_are(options, count):
    assert len({AlfredEnv.episode_key(options, seed) for seed in range(30)}) == (count or 30)
    if "suite" not in options and "trial_file" not in options:
        env = AlfredEnv(**options)
        assert len({env.trial_of(seed).id for seed in range(30)}) == (count or 30)
    if "suite" in options:
        assert AlfredEnv.episode_key({**options, "trial": 1}, 2) != AlfredEnv.episode_key(options, 2)


def test_the_rules_say_how_each_kind_of_task_is_done() -> None:
    for means in ("microwave", "fridge", "faucet", "knife", "lamp"):
        assert means in RULES
