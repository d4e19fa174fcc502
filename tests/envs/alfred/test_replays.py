"""Recorded experts of the seven tasks, replayed in the offline player; and the same with a step left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from agentspec.envs.alfred.goals import Changes, progress
from agentspec.envs.alfred.staging import start
from agentspec.envs.alfred.trials import PAPER, read_trial, trial_path
from agentspec.envs.thor.mining import household
from tests.envs.thor.household import LAYOUTS, OBJECTS, TRIALS, needs_data

ALL = [(task, trial) for task in range(7) for trial in range(3)]


def replay(task: int, trial: int, leave_out=lambda action: False, mine_without: bool = False):
    """Goal progress after the recorded plan, and the actions that failed."""
    one = read_trial(trial_path(Path(TRIALS), task, trial))
    world = start(one, household(one.scene, TRIALS, OBJECTS, LAYOUTS, one.id if mine_without else ""))
    changes, failed = Changes(), []
    event = world.observe()
    for action in one.plan:
        if leave_out(action):
            continue
        event = world.step(action)
        changes.follow(event.metadata, str(action.get("objectId", "")))
        if not event.success:
            failed.append((action, event.error))
    return progress(one.type, one.targets, event.metadata, changes), failed


@needs_data
@pytest.mark.parametrize(("task", "trial"), ALL)
def test_every_recorded_expert_reaches_its_goal_without_a_failure(task, trial):
    reached, failed = replay(task, trial)
    assert not failed
    assert reached.success


@needs_data
def test_there_are_51_goal_conditions():
    # per type 1, 2, 3, 3, 3, 2, 3 (17), three trials each
    assert sum(replay(task, trial)[0].total for task, trial in ALL) == 51
    assert len(PAPER) == 7


@needs_data
def test_most_replays_do_not_need_their_own_plan_in_the_table():
    reached = [replay(task, trial, mine_without=True)[0].success for task, trial in ALL]
    assert sum(reached) >= 20


def puts(action):
    return action["action"] == "PutObject"


def is_action(name, part=""):
    return lambda action: action["action"] == name and part in action.get("objectId", "")


CONTROLS = [
    (0, puts, 0),  # the bat stays in the hand
    (2, is_action("ToggleObjectOn", "Microwave"), 1),  # in the fridge, not hot
    (3, is_action("CloseObject", "Fridge"), 1),  # on the counter, not cold
    (4, is_action("ToggleObjectOn", "Faucet"), 1),  # in the coffee machine, not clean
    (5, is_action("ToggleObjectOn", "DeskLamp"), 1),  # the pencil is held, the lamp is off
]
"""Task, what is left out of its plan, goal conditions met without it."""


@needs_data
@pytest.mark.parametrize(("task", "leave_out", "met"), CONTROLS)
def test_without_the_step_that_matters_the_goal_is_not_reached(task, leave_out, met):
    reached, _ = replay(task, 0, leave_out)
    assert not reached.success and reached.met == met


@needs_data
def test_one_pillow_is_half_of_two():
    taken = []

    def second(action):
        if action["action"] == "PickupObject":
            taken.append(action["objectId"])
        return len(taken) > 1 and action["action"] == "PutObject"

    reached, _ = replay(1, 0, second)
    assert (reached.met, reached.total) == (1, 2)
