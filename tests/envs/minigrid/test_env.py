"""The environment: contract, success at the last step, invalid actions, exact snapshots, size of texts."""

from __future__ import annotations

import random

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import agentspec.envs  # noqa: F401  (registers)
from agentspec.envs import check_environment
from agentspec.envs.minigrid.env import CALLS, MiniGridEnv
from agentspec.envs.minigrid.expert import expert
from agentspec.envs.minigrid.search import shortest_plan
from agentspec.envs.minigrid.suites import PAPER, SUITES
from agentspec.types import Task

VARIANTS = [
    {"max_steps": 9},
    {"suite": "memory", "action_mode": "menu", "observation": "compact", "max_steps": 9},
    {"suite": "babyai", "observation": "basic", "images": True, "max_steps": 9},
    {"level": "MiniGrid-Dynamic-Obstacles-5x5-v0", "max_steps": 9},
]


@pytest.mark.parametrize("options", VARIANTS, ids=str)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_contract_holds(options, seed):
    check_environment(Task("minigrid", seed, options), seed=seed)


def test_gymnasium_accepts_it():
    check_env(gymnasium.make("agentspec/MiniGrid-v0", suite="memory").unwrapped, skip_render_check=True)


def walk(env: MiniGridEnv, plan: list[int]):
    report = None
    for action in plan:
        report = env.step(list(CALLS)[action] + "()")
    return report


def test_a_success_on_the_last_step_is_a_success():
    env = MiniGridEnv(task="empty_6x6_seed42", max_steps=7)
    env.reset()
    _, reward, terminated, truncated, info = walk(env, shortest_plan(env.world))
    # MiniGrid's reward at its own limit: 1 - 0.9 * 7 / 7 = 0.1
    assert (terminated, truncated) == (True, False)
    assert reward == pytest.approx(0.1) and info["metrics"]["success"] == 1.0


def test_efficiency_counts_every_action_also_those_that_were_none():
    env = MiniGridEnv(task="goto_object_6x6_n2_seed7")
    env.reset()
    plan = shortest_plan(env.world)
    *_, info = env.step("I think I should go ahead")
    assert info["invalid"] and info["error_code"] and info["state"]["steps_left"] == 99
    *_, info = walk(env, plan)
    # L* = 4, five steps: 4 / 5; MiniGrid's reward: 1 - 0.9 * 5 / 100 = 0.955
    assert info["metrics"]["efficiency"] == pytest.approx(0.8)
    assert info["metrics"]["reward"] == pytest.approx(0.955)


def test_a_wrong_pickup_fails_and_what_follows_changes_nothing():
    env = MiniGridEnv(task="fetch_5x5_n2_seed99", max_steps=50)
    env.reset()
    # The agent stands at (3, 1), a purple ball at (3, 2) right of its heading north, behind it: turn twice, take it.
    _, reward, terminated, _, info = walk(env, [0, 0, 3])
    assert terminated and reward == 0.0 and info["metrics"] == {"success": 0.0, "efficiency": 0.0, "reward": 0.0}
    after = env.step("FORWARD()")
    assert after[1] == 0.0 and after[2] and after[4]["metrics"] == info["metrics"]


@pytest.mark.parametrize("level", [*SUITES["memory"], *SUITES["babyai"], "MiniGrid-Dynamic-Obstacles-5x5-v0"])
def test_snapshots_are_identities_under_random_play(level):
    rng = random.Random(level)
    env, twin = MiniGridEnv(level=level), MiniGridEnv(level=level)
    env.reset(seed=3)
    twin.reset(seed=8)
    acts = [*(f"{name}()" for name in CALLS), "nonsense"]
    for _ in range(6):
        blob = env.snapshot()
        ahead = [rng.choice(acts) for _ in range(5)]
        first = [env.step(a) for a in ahead]
        for other in (env, twin):
            other.restore(blob)
            assert other.snapshot() == blob
            again = [other.step(a) for a in ahead]
            assert [(r[0]["text"], r[1], r[2], r[3], r[4]["metrics"]) for r in again] == [
                (r[0]["text"], r[1], r[2], r[3], r[4]["metrics"]) for r in first
            ]


def test_bytes_that_are_no_snapshot_are_refused():
    env = MiniGridEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="no snapshot of a MiniGrid environment"):
        env.restore(b"{}")
    with pytest.raises(ValueError, match="version 7"):
        env.restore(env.snapshot().replace(b'"version":1', b'"version":7'))
    before = env.snapshot()
    for old, new in ((b'"history":[]', b'"history":[77]'), (b'"history":[]', b'"history":[-5]'), (b"Empty", b"Void")):
        with pytest.raises(ValueError, match="no snapshot of a MiniGrid environment"):
            env.restore(before.replace(old, new))
    assert env.snapshot() == before


def test_before_the_first_reset_it_is_said_that_there_is_no_episode():
    with pytest.raises(gymnasium.error.ResetNeeded):
        MiniGridEnv().step("FORWARD()")


@pytest.mark.parametrize("mode", ["native", "menu"])
def test_a_level_with_fewer_actions_offers_no_others(mode):
    """Dynamic-Obstacles knows three and turns left for any other; its obstacles move by chance: no L*."""
    options = {"level": "MiniGrid-Dynamic-Obstacles-6x6-v0", "action_mode": mode}
    env = MiniGridEnv(**options)
    _, info = env.reset(seed=3)
    assert list(info["action_schema"].actions) == ["TURN_LEFT", "TURN_RIGHT", "FORWARD"]
    heading = info["state"]["heading"]
    *_, info = env.step("pick up" if mode == "menu" else "PICK_UP()")
    assert info["invalid"] and info["state"]["heading"] == heading
    player, ended = expert(options, random.Random(0)), False
    while not ended:
        *_, terminated, truncated, info = env.step(player.act(info))
        assert not info["invalid"]
        ended = terminated or truncated
    assert info["success"] and info["metrics"]["efficiency"] is None


def test_pictures_are_first_person_and_whole():
    env = MiniGridEnv(task="lava_gap_s5_seed42", images=True, render_mode="rgb_array")
    seen, _ = env.reset()
    assert seen["image"].shape == (196, 196, 3) and seen["image"].dtype == np.uint8
    whole = env.render()
    assert whole.shape == (5 * 28, 5 * 28, 3)
    red, green, blue = (whole[..., i].astype(int) for i in range(3))
    assert ((red > 200) & (green > 100) & (green < 220) & (blue < 130)).any()  # lava is orange


def test_compact_texts_are_short_enough_for_small_models():
    """At most 80 tokens a step in every suite under random play, counted with SmolLM2's vocabulary."""
    transformers = pytest.importorskip("transformers")
    from agentspec.llm.models import ModelNotFoundError, resolve

    try:
        path = resolve("smollm2-135m").path
    except ModelNotFoundError:
        pytest.skip("the bundled model is not installed")
    tokenizer = transformers.AutoTokenizer.from_pretrained(path)
    longest = 0
    for suite in SUITES:
        env = MiniGridEnv(suite=suite, observation="compact", action_mode="menu")
        for seed in range(len(PAPER)):
            seen, info = env.reset(seed=seed)
            rng = random.Random(seed)
            for _ in range(25):
                longest = max(longest, len(tokenizer(seen["text"])["input_ids"]))
                seen, _, terminated, truncated, info = env.step(rng.choice([*info["action_schema"].choices, "hm"]))
                if terminated or truncated:
                    break
    assert longest <= 80


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation": "long"}, "observation is 'long'"),
        ({"action_mode": "keys"}, "action_mode is 'keys'"),
        ({"max_steps": 0}, "max_steps is 0"),
        ({"suite": "x"}, "unknown suite 'x'"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        MiniGridEnv(**options)


def test_the_expert_solves_everything_and_recovers_from_detours():
    from agentspec.envs.experts import player

    for mode in ("native", "menu"):
        for seed in range(10):
            env = MiniGridEnv(suite="paper", action_mode=mode)
            expert = player("agentspec/MiniGrid-v0", "rule_based", {}, random.Random(0))
            _, info = env.reset(seed=seed)
            _, _, terminated, truncated, info = env.step("turn left" if mode == "menu" else "TURN_LEFT()")
            while not (terminated or truncated):
                _, _, terminated, truncated, info = env.step(expert.act(info))
            assert info["metrics"]["success"] == 1.0


def test_a_mission_to_find_the_matching_object_says_what_it_is_to_match():
    rules = {}
    for seed in range(3):  # the three levels of the suite
        env = gymnasium.make("agentspec/MiniGrid-v0", suite="memory")
        _, info = env.reset(seed=seed)
        rules[info["state"]["mission"]] = info["instruction"]
    telling = [mission for mission, told in rules.items() if "the matching object" in told]
    assert len(rules) == 3 and telling == ["go to the matching object at the end of the hallway"]
