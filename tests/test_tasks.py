"""Episodes behind seeds: what is one twice, and what is left to hold out."""

from __future__ import annotations

import pytest

from agentspec.registry import SpecError
from agentspec.tasks import episode_key, make_tasks, unseen_tasks
from agentspec.types import Task

LEVEL = {"level": "MiniGrid-MemoryS7-v0"}


def test_without_a_name_of_its_own_an_episode_is_its_seed() -> None:
    tasks = [Task("deliverybench", seed, {"max_steps": 12}, "train") for seed in range(3)]
    assert len({episode_key(task) for task in tasks}) == 3
    other = Task("deliverybench", 0, {"max_steps": 12}, "test")
    assert episode_key(tasks[0]) == episode_key(other) != episode_key(Task("deliverybench", 0))
    # What the store of an evaluation calls a task is its seed's, whatever the episode.
    assert tasks[0].key == "eb941513bcfd" and other.key != tasks[0].key


def test_what_is_held_out_is_neither_repeated_nor_trained_on() -> None:
    pytest.importorskip("minigrid")
    trained = make_tasks("minigrid", {**LEVEL, "max_steps": 40}, 6)
    found = unseen_tasks("minigrid", LEVEL, 5, trained)
    keys = [episode_key(task) for task in found]
    assert len(set(keys)) == 5 and not {*keys} & {episode_key(task) for task in trained}
    assert episode_key(Task("agentspec/MiniGrid-v0", found[0].seed, LEVEL)) == keys[0]
    # The first such seeds: whoever asks for fewer gets the beginning.
    assert unseen_tasks("minigrid", LEVEL, 2, trained) == found[:2]
    left = 16 - len({episode_key(task) for task in trained})
    assert len(unseen_tasks("minigrid", LEVEL, left, trained)) == left
    with pytest.raises(SpecError, match=f"got 16 tasks, expected at most {left}: minigrid with .*; ask for fewer, or"):
        unseen_tasks("minigrid", LEVEL, 16, trained)


def test_options_that_a_world_does_not_take_are_told() -> None:
    pytest.importorskip("minigrid")
    with pytest.raises(SpecError, match="env 'minigrid': unknown level 'MiniGrid-Memory'"):
        episode_key(Task("minigrid", 0, {"level": "MiniGrid-Memory"}))
