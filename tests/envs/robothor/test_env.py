"""The RoboTHOR environment: contract, geodesics against the dataset, oracle, stop-based success, presets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agentspec.envs import check_environment
from agentspec.envs.robothor.env import RoboThorEnv
from agentspec.envs.robothor.episodes import OWN, VALIDATION, read_episodes, scene_of
from agentspec.envs.robothor.expert import Oracle
from agentspec.envs.robothor.presets import PRESETS
from agentspec.envs.thor.geodesic import distances
from agentspec.envs.thor.mining import apartment
from agentspec.envs.thor.scene import cell_at
from agentspec.types import Task
from tests.envs.thor.household import EPISODES, OBJECTS, needs_data

VAL = {"suite": "validation", "data": EPISODES, "objects": OBJECTS}


def play(seed: int, **options):
    env = RoboThorEnv(**options)
    _, info = env.reset(seed=seed)
    player, ended, total = Oracle(options), False, 0.0
    while not ended:
        _, reward, terminated, truncated, info = env.step(player.act(info))
        total, ended = total + reward, terminated or truncated
    return env, info, total


@pytest.mark.parametrize("preset", list(PRESETS))
@pytest.mark.parametrize("mode", ["native", "menu"])
def test_the_contract_holds(preset, mode):
    check_environment(Task("robothor", 1, {"preset": preset, "action_mode": mode, "max_steps": 9}), seed=1)


@needs_data
def test_the_contract_holds_for_validation_episodes():
    check_environment(Task("robothor", 0, VAL | {"max_steps": 9, "images": True}))


@needs_data
def test_geodesics_agree_with_the_dataset():
    errors, missing = [], 0
    for path in sorted(Path(EPISODES).glob("*.json.gz")):
        name = path.name.removesuffix(".json.gz")
        scene = apartment(name, EPISODES, OBJECTS)
        away = {target: distances(cells, scene.cells)[0] for target, cells in scene.sights.items()}
        for episode in read_episodes(Path(EPISODES), name).values():
            length = away[episode.target].get(cell_at(episode.x, episode.z))
            if length is None:
                missing += 1
            else:
                errors.append(abs(length - episode.length))
    assert len(errors) + missing == 1800 and missing <= 12
    assert np.median(errors) <= 0.05 and np.percentile(errors, 95) <= 0.4


@needs_data
def test_the_oracle_finds_all_ten_and_stopping_at_once_finds_none():
    spl = []
    for seed in range(10):
        _, info, total = play(seed, **VAL)
        assert info["success"] and total == 1.0
        spl.append(info["metrics"]["spl"])
        env = RoboThorEnv(**VAL)
        env.reset(seed=seed)
        *_, terminated, _, info = env.step("STOP()")
        assert terminated and info["metrics"]["success"] == info["metrics"]["spl"] == 0.0
    assert np.mean(spl) >= 0.9


@needs_data
def test_the_ten_are_of_distinct_scenes_and_classes_on_right_angles():
    episodes = [read_episodes(Path(EPISODES), scene_of(name))[name] for name in VALIDATION]
    assert len({e.scene for e in episodes}) == len({e.target for e in episodes}) == 10
    assert all(e.yaw % 90 == 0 for e in episodes)


@pytest.mark.parametrize("preset", list(PRESETS))
@pytest.mark.parametrize("seed", range(1, 10, 3))
def test_the_oracle_finds_ours_in_every_preset(preset, seed):
    _, info, _ = play(seed, preset=preset)
    assert info["success"] and info["metrics"]["spl"] > 0.6


def test_presets_are_those_of_the_paper_and_the_challenge():
    paper, challenge, case = (PRESETS[name].settings for name in ("paper", "challenge2021", "casestudy"))
    assert (paper.rotate_step, paper.camera.field_of_view, paper.visibility, paper.grid) == (90.0, 90.0, 1.5, 0.25)
    assert (challenge.rotate_step, challenge.visibility, challenge.width, challenge.height) == (30.0, 1.0, 640, 480)
    assert (case.rotate_step, case.grid) == (45.0, 0.5)
    assert [PRESETS[name].max_steps for name in PRESETS] == [200, 500, 200]


def test_progress_pays_metres_of_the_way_and_success_one():
    _, info, total = play(4, reward="progress")
    assert info["success"] and 1.0 < total <= 2.0 + 1e-9


def test_snapshots_are_identities():
    env, twin = RoboThorEnv(), RoboThorEnv()
    _, info = env.reset(seed=8)
    twin.reset(seed=2)
    player = Oracle({})
    for _ in range(10):
        blob = env.snapshot()
        twin.restore(blob)
        assert twin.snapshot() == blob
        text = player.act(info)
        mine, theirs = env.step(text), twin.step(text)
        assert mine[0] == theirs[0] and mine[1:4] == theirs[1:4]
        info = mine[4]


def test_a_blocked_move_takes_a_step_and_is_told():
    env = RoboThorEnv(preset="casestudy", action_mode="menu")
    env.reset(seed=0)
    _, _, _, _, info = env.step("move ahead")  # the sofa is less than 0.5 m ahead
    assert not info["invalid"] and "could not move ahead" in info["message"]
    assert info["metrics"]["path_length"] == 0.0 and info["state"]["steps_left"] == 199


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"data": "."}, "the suite `own` reads no data"),
        ({"objects": "."}, "the suite `own` reads no data"),
        ({"suite": "validation", "data": "nowhere"}, "data is 'nowhere': there is no such folder"),
        ({"episode": "FloorPlan_Val1_1_Apple_0", "data": ".", "objects": "nowhere"}, "objects is 'nowhere'"),
    ],
)
def test_folders_that_are_not_there_or_not_read_are_refused(options, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        RoboThorEnv(**options)


@pytest.mark.parametrize(("options", "count"), [({}, len(OWN)), ({"suite": "validation"}, 10), ({"episode": "x"}, 1)])
def test_how_many_episodes_there_are(options, count):
    assert len({RoboThorEnv.episode_key(options, seed) for seed in range(3 * count)}) == count
    if not options:
        env = RoboThorEnv()
        named = {(RoboThorEnv.episode_key({}, seed), env.episode_of(seed).id) for seed in range(3 * count)}
        assert len(named) == len({id for _, id in named}) == count
