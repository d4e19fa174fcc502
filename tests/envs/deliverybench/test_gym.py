"""Gymnasium's manners: copies, pickles, the end of an episode, limits, discrete actions and numbers."""

from __future__ import annotations

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from agentspec.envs.deliverybench import STEP_LIMIT
from agentspec.envs.deliverybench.discrete import COURIER, SLOT, MenuActions, Numbers, make
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier
from agentspec.envs.deliverybench.view.choices import KINDS
from agentspec.envs.deliverybench.view.menu import MAX_CHOICES, MORE
from agentspec.envs.deliverybench.world.rules import MODES
from tests.envs.deliverybench.helpers import world

DISCRETE = "agentspec/DeliveryBenchDiscrete-v0"


def tiny(**options) -> DeliveryBenchEnv:
    return DeliveryBenchEnv(**{"size": "tiny", **options})


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_an_environment_is_copied_in_the_middle_of_a_shift(copied) -> None:
    env = tiny(action_mode="menu", max_steps=60, order_seed="seed")
    _, info = env.reset(seed=4)
    courier = RuleBasedCourier(env.city)
    for _ in range(15):
        *_, info = env.step(courier.act(info))
    other = copied(env)
    assert other is not env and other.city is env.city and other.snapshot() == env.snapshot()
    other.step("wait 1 minute")
    assert env.world.state.tick != other.world.state.tick
    # The stream of seeds goes on alike.
    mine, theirs = copied(env), env
    assert mine.reset()[1]["state"]["offers"] == theirs.reset()[1]["state"]["offers"]


def test_an_environment_is_copied_before_its_first_reset() -> None:
    env = copy.deepcopy(tiny(start_battery=20.0))
    assert env.reset(seed=0)[1]["state"]["battery"] == 20.0


def test_a_world_is_copied_and_pickled() -> None:
    one = world("fair")
    one.step("ACCEPT_ORDER([0])")
    for other in (copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        assert other.snapshot() == one.snapshot()
        other.step("WAIT(10)")
        assert other.state.tick == one.state.tick + 100
        # A bus ride needs the timetable to grow on.
        assert other.timetable.phase(10**6) == one.timetable.phase(10**6)


@pytest.mark.parametrize("options", [{"max_steps": 3}, {"rules": "original"}, {"shift_hours": 0.01}])
def test_a_step_after_the_end_changes_nothing(options: dict) -> None:
    env = tiny(**options)
    env.reset(seed=0)
    ended = False
    while not ended:
        observation, _, terminated, truncated, info = env.step("WAIT(20)")
        ended = terminated or truncated
    blob = env.snapshot()
    for action in ("ACCEPT_ORDER([0])", "WAIT(5)", "nonsense"):
        again, reward, *flags, told = env.step(action)
        assert again["text"] == observation["text"] and reward == 0.0 and flags == [terminated, truncated]
        assert told["error_code"] == "ENDED" and told["events"] == [] and told["metrics"] == info["metrics"]
        assert env.snapshot() == blob


def test_the_step_limit_is_registered_and_kept() -> None:
    assert gymnasium.spec("agentspec/DeliveryBench-v0").max_episode_steps == STEP_LIMIT
    assert gymnasium.spec(DISCRETE).max_episode_steps == STEP_LIMIT
    with pytest.raises(ValueError, match="5001; expected 1 to 5000"):
        tiny(max_steps=STEP_LIMIT + 1)


def test_looking_for_ever_ends_the_shift() -> None:
    env = tiny(shift_hours=0.1)
    env.reset(seed=0)
    # The first look is free, each further one takes 10 s of the 360.
    looks, terminated = 0, False
    while not terminated:
        _, _, terminated, _, info = env.step("VIEW_ORDERS()")
        looks += 1
    assert looks == 37 and info["state"]["left_s"] == 0.0


def test_what_takes_no_time_ends_at_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agentspec.envs.deliverybench.env.STEP_LIMIT", 50)
    env = tiny()
    env.reset(seed=0)
    assert [env.step("nonsense")[3] for _ in range(50)].index(True) == 49
    _, info = env.observe()
    assert info["metrics"]["cut"] and info["report"]["meta"]["profit_per"] == "hour played"


def test_profit_of_a_cut_episode_is_per_hour_played() -> None:
    env = tiny(max_steps=12, size="tiny", action_mode="menu", shift_hours=2.0)
    _, info = env.reset(seed=1)
    courier, ended = RuleBasedCourier(env.city), False
    while not ended:
        _, _, terminated, truncated, info = env.step(courier.act(info))
        ended = terminated or truncated
    played = info["state"]["clock_s"] / 3600.0
    assert truncated and 1.0 / 60.0 < played < 1.0 and info["net_earnings"] != 0.0
    metrics, meta = info["metrics"], info["report"]["meta"]
    assert metrics["hourly_profit"] == pytest.approx(info["net_earnings"] / played)
    assert metrics["hours_paid"] == pytest.approx(played) and metrics["cut"]
    assert meta["profit_per"] == "hour played" and meta["hours_paid"] == pytest.approx(played)


def test_profit_of_a_whole_shift_is_per_hour_of_it() -> None:
    env = tiny(shift_hours=0.5)
    env.reset(seed=0)
    env.step("RENT_CAR()")
    *_, terminated, _, info = env.step("WAIT(1800)")
    assert terminated and not info["metrics"]["cut"] and info["metrics"]["hours_paid"] == 0.5
    assert info["report"]["meta"]["profit_per"] == "hour of the shift"


@pytest.mark.filterwarnings("ignore:.*render.*", "ignore:.*unwrapped version.*")
@pytest.mark.parametrize("observation", ["numbers", "compact"])
def test_the_discrete_environment_passes_the_checker(observation: str) -> None:
    env = gymnasium.make(DISCRETE, size="tiny", shift_hours=0.1, observation=observation)
    check_env(env, skip_render_check=True)


def test_discrete_actions_are_the_places_of_the_menu() -> None:
    env = gymnasium.make(DISCRETE, size="tiny")
    _, info = env.reset(seed=0)
    choices = info["action_schema"].choices
    assert env.action_space.n == MAX_CHOICES and info["action_mask"].dtype == np.int8
    assert info["action_mask"].tolist() == [1] * len(choices) + [0] * (MAX_CHOICES - len(choices))
    at = next(i for i, choice in enumerate(choices) if choice.startswith("accept order "))
    *_, info = env.step(at)
    assert info["events"] == ["accepted"] and not info["invalid"]
    assert env.action_space.sample(info["action_mask"]) < len(info["action_schema"].choices)
    empty = int(info["action_mask"].sum())
    _, reward, _, _, told = env.step(empty)
    assert told["invalid"] and reward == 0.0 and told["state"]["clock_s"] == info["state"]["clock_s"]


def test_numbers_describe_courier_and_choices() -> None:
    env = gymnasium.make(DISCRETE, size="tiny")
    observation, info = env.reset(seed=0)
    assert observation.shape == (COURIER + MAX_CHOICES * SLOT,) and observation.dtype == np.float32
    # One hour left, full energy, half a battery, nothing earned; on the scooter.
    assert observation[:4].tolist() == [1.0, 1.0, 0.5, 0.0]
    assert observation[COURIER - len(MODES) : COURIER].tolist() == [float(m == "e-scooter") for m in MODES]
    choices = info["action_schema"].choices
    slots = observation[COURIER:].reshape(MAX_CHOICES, SLOT)
    assert slots[:, 0].tolist() == info["action_mask"].tolist()
    more = choices.index(MORE.text)
    assert slots[more, 4:].tolist() == [float(kind == "more") for kind in KINDS]
    at = next(i for i, choice in enumerate(choices) if choice.startswith("accept order "))
    offer = next(o for o in info["state"]["offers"] if o["id"] == int(choices[at].split()[-1]))
    assert slots[at, 3] == pytest.approx(offer["pay"] / 10.0)
    assert slots[at, 1] == pytest.approx((offer["to_pickup_m"] + offer["distance_m"]) / 1000.0)


def test_the_same_episode_by_numbers_and_by_texts() -> None:
    numbers, texts = gymnasium.make(DISCRETE, size="tiny"), tiny(action_mode="menu", observation="compact")
    _, info = numbers.reset(seed=2)
    _, told = texts.reset(seed=2)
    courier = RuleBasedCourier(texts.city)
    for _ in range(30):
        text = courier.act(told)
        *_, told = texts.step(text)
        *_, info = numbers.step(info["action_schema"].choices.index(text))
        assert info["state_hash"] == told["state_hash"] and info["balance"] == told["balance"]


def test_wrappers_say_what_they_need() -> None:
    with pytest.raises(ValueError, match='action_mode="menu"'):
        MenuActions(tiny())
    with pytest.raises(ValueError, match="'pixels'; expected one of 'numbers'"):
        make(observation="pixels")
    with pytest.raises(ValueError, match="'native'; discrete actions need the menu"):
        make(action_mode="native")
    assert Numbers(MenuActions(tiny(action_mode="menu"))).reset(seed=0)[0].any()


def test_a_number_below_zero_is_no_choice() -> None:
    env = gymnasium.make("agentspec/DeliveryBenchDiscrete-v0", size="tiny", shift_hours=0.1, observation="compact")
    before = env.reset(seed=0)[1]
    _, reward, _, _, after = env.step(-1)
    assert after["invalid"] and reward == 0.0 and after["state"]["clock_s"] == before["state"]["clock_s"]
