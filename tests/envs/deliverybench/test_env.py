"""The Gymnasium environment: its contract, its determinism, exact snapshots, and readable failures."""

from __future__ import annotations

import importlib
import random
import re

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from agentspec.envs import deliverybench
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier
from agentspec.envs.deliverybench.expert.scripted import luck
from agentspec.types import ActionSchema
from tests.envs.deliverybench.fuzz import hostile_text

ID = "agentspec/DeliveryBench-v0"
KEYS = {
    "instruction", "action_schema", "state", "balance", "net_earnings", "error", "error_code", "message", "invalid",
    "events", "seconds", "native_action", "metrics", "rules", "state_hash",
    "thought",
}  # fmt: skip


def tiny(**options) -> DeliveryBenchEnv:
    return DeliveryBenchEnv(**{"size": "tiny", **options})


def strip(info: dict) -> dict:
    return {k: v for k, v in info.items() if k != "action_schema"}


@pytest.mark.filterwarnings("ignore:.*render.*")
@pytest.mark.parametrize("options", [{}, {"observation": "compact", "action_mode": "menu"}, {"images": True}])
def test_gymnasium_checker_passes(options: dict) -> None:
    check_env(gymnasium.make(ID, size="tiny", shift_hours=0.1, **options).unwrapped, skip_render_check=True)


def test_registration_is_idempotent() -> None:
    before = gymnasium.registry[ID]
    importlib.reload(deliverybench)
    assert gymnasium.registry[ID] is before


@pytest.mark.parametrize("mode", ["native", "menu"])
def test_info_has_its_contract(mode: str) -> None:
    env = tiny(action_mode=mode)
    observation, info = env.reset(seed=0)
    assert set(info) >= KEYS and isinstance(info["action_schema"], ActionSchema)
    assert bool(info["action_schema"].choices) is (mode == "menu")
    assert env.observation_space.contains(observation)
    assert info["balance"] == 100.0 and info["net_earnings"] == 0.0 and info["events"] == [] and not info["invalid"]


def test_rewards_add_up_to_net_earnings_and_events_to_deliveries() -> None:
    env = tiny(action_mode="menu", observation="compact")
    _, info = env.reset(seed=1)
    courier, total, events, ended = RuleBasedCourier(env.city), 0.0, [], False
    while not ended:
        _, reward, terminated, truncated, info = env.step(courier.act(info))
        total += reward
        events += info["events"]
        ended = terminated or truncated
    assert terminated and not truncated and env.world.state.reason == "shift"
    assert total == pytest.approx(info["net_earnings"]) and total == pytest.approx(
        info["report"]["money"]["net_growth"]
    )
    n = info["metrics"]["deliveries"]
    assert n >= 2 and events.count("delivered") == n == events.count("on_time") + events.count("late")
    assert events.count("picked_up") >= n and events.count("bagged") >= n and events.count("accepted") >= n
    assert info["metrics"]["hourly_profit"] == pytest.approx(total)  # a shift of one hour


def test_max_steps_truncates() -> None:
    env = tiny(max_steps=2)
    env.reset(seed=0)
    assert env.step("VIEW_ORDERS()")[2:4] == (False, False)
    *_, terminated, truncated, info = env.step("VIEW_ORDERS()")
    assert info["rules"] == "fair" and info["report"]["meta"]["rules"] == "fair"
    assert truncated and not terminated and info["state"]["calls_left"] == 0


def test_original_rules_end_after_200_actions_and_fair_ones_do_not() -> None:
    env = tiny(rules="original")
    env.reset(seed=0)
    for _ in range(200):
        _, _, terminated, truncated, info = env.step("VIEW_ORDERS()")
    assert truncated and not terminated
    fair = tiny()
    assert fair.reset(seed=0)[1]["state"]["calls_left"] is None
    assert not any(fair.step("VIEW_ORDERS()")[3] for _ in range(300))
    _, reward, _, truncated, info = env.step("WAIT(5)")
    assert reward == 0.0 and truncated and info["error_code"] == "ENDED"


def test_hourly_profit_is_told_at_every_step() -> None:
    env = tiny(shift_hours=0.5)
    courier, ended = RuleBasedCourier(env.city), False
    _, info = env.reset(seed=1)
    assert info["metrics"]["hourly_profit"] == 0.0
    while not ended:
        _, _, terminated, truncated, info = env.step(courier.act(info))
        ended = terminated or truncated
        # Dollars in half an hour, times two.
        assert info["metrics"]["hourly_profit"] == pytest.approx(2.0 * info["net_earnings"])


def test_same_seed_same_episode_and_the_stream_continues() -> None:
    a, b = tiny(), tiny()
    assert a.reset(seed=5)[0] == b.reset(seed=5)[0]
    for action in ("ACCEPT_ORDER([0, 1])", "MOVE(10m, 20m)", "WAIT(30)", "??"):
        left, right = a.step(action), b.step(action)
        assert left[0] == right[0] and strip(left[4]) == strip(right[4])
    assert a.reset()[1]["state"]["offers"] == b.reset()[1]["state"]["offers"]
    assert a.reset()[1]["state"]["offers"] != a.reset(seed=5)[1]["state"]["offers"]


def test_order_seed_options() -> None:
    original = tiny(order_seed="original")
    pools = [original.reset(seed=s)[1]["state"]["offers"] for s in (1, 2)]
    assert pools[0] == pools[1] and original.world.seed is None
    fixed = tiny(order_seed=7)
    fixed.reset(seed=1)
    assert fixed.world.seed == 7


def test_thinking_is_free_or_charged_by_call_and_token() -> None:
    free, priced = tiny(), tiny(think_time={"call": 2.0, "token": 0.05})
    free.reset(seed=0)
    priced.reset(seed=0)
    free.deliberate(3, 500)
    assert free.step("WAIT(10)")[4]["seconds"] == 10.0
    # Unreported: one call. Reported: 3 x 2 s + 40 x 0.05 s. A scripted agent reports none.
    assert priced.step("WAIT(10)")[4]["seconds"] == 12.0
    priced.deliberate(3, 40)
    blob = priced.snapshot()
    *_, info = priced.step("WAIT(10)")
    assert info["seconds"] == 18.0 and info["thought"] == [3, 40]
    priced.restore(blob)
    assert priced.step("WAIT(10)")[4]["seconds"] == 18.0
    priced.deliberate(0, 0)
    *_, info = priced.step("WAIT(10)")
    assert info["seconds"] == 10.0 and info["state"]["clock_s"] == 12.0 + 18.0 + 10.0
    priced.deliberate(1, 10**6)
    *_, terminated, truncated, info = priced.step("ACCEPT_ORDER([1])")
    assert terminated and not truncated and info["events"] == [] and "thinking" in info["message"]
    with pytest.raises(ValueError, match="-1 calls"):
        priced.deliberate(-1)


def test_start_battery() -> None:
    assert tiny(start_battery=20.0).reset(seed=0)[1]["state"]["battery"] == 20.0


@pytest.mark.parametrize("mode", ["native", "menu"])
def test_snapshot_is_exact(mode: str) -> None:
    env = tiny(action_mode=mode, images=True, max_steps=40)
    _, info = env.reset(seed=3)
    courier = luck({}, random.Random(0))
    for _ in range(8):
        *_, info = env.step(courier.act(info))
    blob = env.snapshot()
    plan = ["WAIT(10)", "ACCEPT_ORDER([5])", "MOVE(30m, 30m)", "nonsense"]

    def play(target: DeliveryBenchEnv) -> list:
        rows = []
        for action in plan:
            observation, reward, terminated, truncated, info = target.step(action)
            rows.append(
                (observation["text"], observation["image"].tobytes(), reward, terminated, truncated, strip(info))
            )
        return rows

    here, first = env.observe(), play(env)
    env.restore(blob)
    again = env.observe()
    assert again[0]["text"] == here[0]["text"] and strip(again[1]) == strip(here[1])
    assert env.snapshot() == blob and play(env) == first
    other = tiny(action_mode=mode, images=True, max_steps=40)
    other.reset(seed=99)
    other.restore(blob)
    other.observe()
    assert play(other) == first


@pytest.mark.filterwarnings("ignore::SyntaxWarning")
@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(0, 40),
    st.sampled_from(["native", "menu"]),
    st.sampled_from(["fair", "original"]),
)
def test_restoring_is_an_identity_under_random_play(seed: int, steps: int, mode: str, rules: str) -> None:
    env = tiny(action_mode=mode, rules=rules, think_time={"call": 1.0})
    rng = random.Random(seed)

    def play(target: DeliveryBenchEnv, dice: random.Random, count: int) -> list:
        rows = []
        for _ in range(count):
            courier = luck({}, dice)
            text = hostile_text(dice) if dice.random() < 0.2 else courier.act(target.observe()[1])
            if dice.random() < 0.2:
                target.deliberate(dice.randrange(3), 10)
            observation, reward, terminated, truncated, info = target.step(text)
            rows.append((observation, reward, terminated, truncated, strip(info)))
        return rows

    env.reset(seed=seed)
    play(env, rng, steps)
    blob, here = env.snapshot(), env.observe()
    first = play(env, random.Random(seed + 1), 15)
    after = env.snapshot()
    other = tiny(action_mode=mode, rules=rules, think_time={"call": 1.0})
    other.reset(seed=seed + 7)
    for target in (env, other):
        target.restore(blob)
        assert target.snapshot() == blob
        again = target.observe()
        assert again[0] == here[0] and strip(again[1]) == strip(here[1])
        assert play(target, random.Random(seed + 1), 15) == first
        assert target.snapshot() == after


@pytest.mark.parametrize(
    "blob",
    [b"", b"{}", b"[1]", b"\xff\x00", b'{"version": 9, "seed": 0, "world": "", "steps": 0, "last": {}, "track": []}'],
)
def test_foreign_bytes_are_refused(blob: bytes) -> None:
    env = tiny()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="snapshot"):
        env.restore(blob)


def test_menu_takes_choices_and_calls_and_explains_the_rest() -> None:
    env = tiny(action_mode="menu")
    _, info = env.reset(seed=0)
    choice = next(c for c in info["action_schema"].choices if c.startswith("accept order "))
    *_, info = env.step(f"  {choice.upper()} ")
    assert not info["invalid"] and info["native_action"].startswith("ACCEPT_ORDER") and info["events"] == ["accepted"]
    *_, info = env.step("VIEW_BAG()")
    assert not info["invalid"]
    *_, info = env.step("fly away")
    assert info["invalid"] and info["error_code"] == "PARSE_NOT_CALL" and "hurry to" in info["error"]
    assert info["message"].startswith("failed: ")


@pytest.mark.parametrize("text", ["", "\x00\udcff", "MOVE(" * 500, "é" * 3000, "{", "DROP_OFF(oid=[], method=7)"])
def test_any_text_is_survived_and_shown_as_printable(text: str) -> None:
    env = tiny()
    env.reset(seed=0)
    observation, reward, *_, info = env.step(text)
    assert info["invalid"] and info["error"] and reward == 0.0
    assert env.observation_space.contains(observation)


def test_state_hash_tells_states_apart() -> None:
    env = tiny()
    _, info = env.reset(seed=0)
    first = info["state_hash"]
    assert env.step("VIEW_BAG()")[4]["state_hash"] == first
    assert env.step("ACCEPT_ORDER([0])")[4]["state_hash"] != first
    assert env.reset(seed=0)[1]["state_hash"] == first


def test_step_before_reset_is_an_error() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        tiny().step("WAIT(1)")


@pytest.mark.parametrize(
    "options",
    [
        {"observation": "long"}, {"action_mode": "free"}, {"render_mode": "human"}, {"order_seed": "random"},
        {"max_steps": 0}, {"start_battery": 101.0}, {"size": "huge"}, {"rules": "easy"},
        {"think_time": "free"}, {"think_time": {"calls": 1}},
    ],
)  # fmt: skip
def test_wrong_arguments_are_explained(options: dict) -> None:
    with pytest.raises(ValueError, match=re.escape(str(next(iter(options.values()))))):
        tiny(**options)


def test_think_time_prices_are_numbers() -> None:
    for price in (-1.0, float("nan"), "2", True):
        with pytest.raises(ValueError, match="think_time 'call' is"):
            tiny(think_time={"call": price})


def test_images_are_pictures() -> None:
    env = tiny(images=True, render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    assert observation["image"].dtype == np.uint8 and observation["image"].shape == (480, 720, 3)
    assert np.array_equal(env.render(), observation["image"])
    assert tiny().render() is None
