"""The paper's ten tasks, suites, and errors."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
from minigrid.core.world_object import Box, Key

from agentspec.envs.minigrid.env import CALLS, MiniGridEnv
from agentspec.envs.minigrid.expert import expert
from agentspec.envs.minigrid.search import _contents, optimum, shortest_plan
from agentspec.envs.minigrid.suites import PAPER, SUITES, layout_of

SHARED = Path(__file__).parents[4] / "shared" / "minigrid_optimal.json"
OPTIMA = [7, 4, 5, 5, 14, 14, 8, 5, 26, 14]


def test_the_optima_of_the_ten_tasks_are_found_by_search():
    assert [optimum(layout.id, layout.seed) for layout in PAPER] == OPTIMA
    assert [layout.optimal for layout in PAPER] == OPTIMA


@pytest.mark.skipif(not SHARED.exists(), reason=f"{SHARED} is absent: recorded plans of the ten tasks")
@pytest.mark.parametrize("layout", PAPER, ids=lambda layout: layout.name)
def test_recorded_plans_solve_the_ten_tasks(layout):
    recorded = json.loads(SHARED.read_text())[layout.name]
    assert (recorded["env_id"], recorded["seed"], recorded["optimal_steps"]) == (layout.id, layout.seed, layout.optimal)
    words = {"left": 0, "right": 1, "forward": 2, "pickup": 3, "drop": 4, "toggle": 5, "done": 6}
    env = MiniGridEnv(task=layout.name)
    _, info = env.reset(seed=5)
    assert info["state"]["mission"] == recorded["mission"]
    for word in recorded["plan"]:
        _, _, terminated, _, info = env.step(list(CALLS)[words[word]] + "()")
    assert terminated and info["metrics"]["success"] == 1.0 and info["metrics"]["efficiency"] == 1.0


def test_the_paper_suite_cycles_and_the_others_vary_the_layout():
    assert layout_of(suite="paper", seed=13) == PAPER[3]
    assert layout_of(suite="memory", seed=4).id == SUITES["memory"][1]
    assert layout_of(suite="memory", seed=4).seed == 4
    assert layout_of(level="BabyAI-GoToObj-v0", seed=9).seed == 9


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "neither suite, level nor task"),
        ({"suite": "paper", "task": "x"}, "suite and task"),
        ({"suite": "papr"}, "did you mean paper"),
        ({"level": "MiniGrid-Empty-6x6-v9"}, "did you mean MiniGrid-Empty-6x6-v0"),
        ({"task": "empty_6x6_seed43"}, "did you mean empty_6x6_seed42"),
    ],
)
def test_unknown_layouts_are_refused_with_the_nearest_name(given, message):
    with pytest.raises(ValueError, match=message):
        layout_of(**given)


def test_the_search_leaves_the_world_untouched():
    env = MiniGridEnv(suite="memory")
    env.reset(seed=2)
    env.step("FORWARD()")
    before = (env.world.grid.encode().tolist(), tuple(env.world.agent_pos), env.world.step_count, env.world.max_steps)
    plan = shortest_plan(env.world)
    assert plan and before == (
        env.world.grid.encode().tolist(),
        tuple(env.world.agent_pos),
        env.world.step_count,
        env.world.max_steps,
    )
    for action in plan:
        *_, info = env.step(list(CALLS)[action] + "()")
    assert info["success"]


def test_a_mission_that_cannot_be_fulfilled_any_more_has_no_plan():
    env = MiniGridEnv(task="fetch_5x5_n2_seed99")
    env.reset()
    env.world.max_steps = 10
    assert shortest_plan(env.world, most_states=3) is None


def test_practice_holds_none_of_the_ten_layouts():
    levels = SUITES["paper"] + SUITES["memory"]
    assert SUITES["practice"] == levels
    tested = {(layout.id, layout.seed) for layout in PAPER}
    drawn = [layout_of(suite="practice", seed=seed) for seed in range(10_000)]
    assert {layout.id for layout in drawn} == set(levels)
    assert not tested & {(layout.id, layout.seed) for layout in drawn}


def test_the_expert_of_practice_looks_before_it_chooses():
    """Memory's seed 10 starts past the cue, which one turn to the left shows; the shortest plan never sees it."""
    world = {"level": "MiniGrid-MemoryS7-v0", "observation": "compact", "action_mode": "menu"}
    played = {}
    for look in (False, True):
        env = MiniGridEnv(**world)
        _, info = env.reset(seed=10)
        player = expert({}, random.Random(0), look=look)
        seen, ended = [], False
        while not ended:
            observation, _, ended, _, info = env.step(player.act(info))
            seen.append(observation["text"])
        assert info["success"]
        played[look] = (len(seen), any("green ball 1 forward, 3 left" in text for text in seen))
    assert played == {False: (3, False), True: (5, True)}
    assert expert({"suite": "practice"}, random.Random(0))._look and not expert({}, random.Random(0))._look


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({}, 10),
        ({"suite": "paper"}, 10),
        ({"task": PAPER[3].name}, 1),
        ({"suite": None, "level": "MiniGrid-Empty-8x8-v0"}, 1),
        ({"level": "MiniGrid-MemoryS7-v0"}, 16),  # two objects x two ends of a hallway x four places: see the level
        ({"level": "MiniGrid-Dynamic-Obstacles-5x5-v0"}, 200),  # obstacles move by chance, which the seed decides
    ],
)
def test_which_episode_a_seed_starts(options: dict[str, str], count: int) -> None:
    """Names are equal where the first observation, seen from above, is."""
    assert len({MiniGridEnv.episode_key(options, seed) for seed in range(200)}) == count
    env = MiniGridEnv(**{name: value or "" for name, value in options.items()})
    first: dict[str, set[str]] = {}
    for seed in range(60):
        env.reset(seed=seed)
        picture = f"{env.layout.id} {env.world.mission} {env.world.agent_pos} {env.world.pprint_grid()}"
        first.setdefault(MiniGridEnv.episode_key(options, seed), set()).add(picture)
    assert all(len(pictures) == 1 for pictures in first.values())
    if "Dynamic" not in str(options):
        assert len(set.union(*first.values())) == len(first)


def test_what_a_box_holds_and_how_an_episode_is_shown() -> None:
    """A hidden key is a part of the start; texts and limits are not."""
    level = {"level": "MiniGrid-ObstructedMaze-1Dlh-v0"}
    assert MiniGridEnv.episode_key({**level, "observation": "compact", "max_steps": 5}, 7) == MiniGridEnv.episode_key(
        level, 7
    )
    assert _contents(Box("red", Key("blue"))) != _contents(Box("red", Key("green"))) != _contents(Box("red"))
