"""The scripted couriers: the planner on rounds small enough to check by hand, and what the couriers earn."""

from __future__ import annotations

import math
import random
from statistics import mean

import pytest

from agentspec.envs.deliverybench.city.generate import generate
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.expert import errands
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier, Style
from agentspec.envs.deliverybench.expert.errands import Upkeep
from agentspec.envs.deliverybench.expert.planning import DROPOFF, PICKUP, Job, Planner, Stop, payment
from agentspec.envs.deliverybench.expert.scripted import luck
from agentspec.envs.experts import NoPlayer, player, roles
from agentspec.episode import Job as EpisodeJob
from agentspec.episode import Runner
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.envs.deliverybench.test_citymap import REFERENCE, needs_reference

QUICK = {
    "size": "tiny", "shift_hours": 0.3, "observation": "compact", "action_mode": "menu", "max_steps": 16,
}  # fmt: skip


def planner(**options) -> Planner:
    values = {"metres": math.dist, "speed": 10.0, "second": 0.01, "metre": 0.0, "stop": 0.0, **options}
    return Planner(**values)


def play(options: dict, seed: int, courier: str) -> tuple[float, int, int]:
    """Net earnings, steps and deliveries of one episode."""
    env = DeliveryBenchEnv(**options)
    policy = RuleBasedCourier(env.city) if courier == "rule" else luck({}, random.Random(seed))
    _, info = env.reset(seed=seed)
    steps, ended = 0, False
    while not ended:
        _, _, terminated, truncated, info = env.step(policy.act(info))
        steps += 1
        ended = terminated or truncated
    return info["net_earnings"], steps, info["metrics"]["deliveries"]


def test_payment_follows_the_settlement() -> None:
    # Full pay and three dollars in time; 1.50 until 1.25 times the limit; full base within the minute of grace.
    assert payment(6.0, 100.0, 100.0) == 9.0
    assert payment(6.0, 120.0, 100.0) == 7.5
    assert payment(6.0, 150.0, 100.0) == 6.0
    assert payment(6.0, 200.0, 100.0) == 3.0  # half: limit / elapsed


def test_worth_by_hand() -> None:
    p = planner()
    p.jobs[1] = Job(1, (100.0, 0.0), (200.0, 0.0), pay=5.0, limit=100.0, ready=30.0)
    stops = [Stop(1, PICKUP, (100.0, 0.0)), Stop(1, DROPOFF, (200.0, 0.0))]
    # 10 s there, 20 s waiting, 10 s on: 40 s, of which 20 s are idle and free here. 5 + 3 - 20 x 0.01.
    worth = p.worth((0.0, 0.0), stops)
    assert (worth.seconds, worth.metres, worth.income) == (40.0, 200.0, 8.0)
    assert worth.value == pytest.approx(7.8)
    assert planner(horizon=39.0, jobs=p.jobs).worth((0.0, 0.0), stops).income == 0.0
    # Way, pick-up and bag, way, drop-off: five actions.
    assert planner(actions=4, jobs=p.jobs).worth((0.0, 0.0), stops).income == 0.0
    assert planner(actions=5, jobs=p.jobs).worth((0.0, 0.0), stops).income == 8.0


def test_insertion_finds_the_order_on_the_way() -> None:
    p = planner()
    far = Job(1, (0.0, 0.0), (300.0, 0.0), pay=5.0, limit=1000.0)
    near = Job(2, (100.0, 0.0), (200.0, 0.0), pay=5.0, limit=1000.0)
    _, stops = p.build((0.0, 0.0), [far, near])
    assert [(s.job, s.kind) for s in stops] == [(1, PICKUP), (2, PICKUP), (2, DROPOFF), (1, DROPOFF)]


def test_a_picked_order_has_only_its_dropoff_left() -> None:
    p = planner()
    known = [Stop(1, PICKUP, (0.0, 0.0)), Stop(1, DROPOFF, (50.0, 0.0)), Stop(9, DROPOFF, (1.0, 1.0))]
    _, stops = p.build((0.0, 0.0), [Job(1, (0.0, 0.0), (60.0, 0.0), 5.0, 100.0, picked=True)], known)
    assert stops == [Stop(1, DROPOFF, (60.0, 0.0))]


def test_choose_takes_pairs_that_pay_only_together() -> None:
    # The restaurant is 1000 m away (100 s, $8 at 8 cents a second). One order ($3 + $3) does not pay for the way of
    # $8 there and 0.80 on; two to the same door do: 12 - 8.8 = 3.2.
    p = planner(second=0.08)
    jobs = [Job(n, (1000.0, 0.0), (1100.0, 0.0), pay=3.0, limit=1000.0) for n in (1, 2)]
    taken, stops = p.choose((0.0, 0.0), [], jobs, room=5, margin=0.0)
    assert sorted(taken) == [1, 2] and len(stops) == 4
    assert p.choose((0.0, 0.0), [], jobs[:1], room=5, margin=0.0) == ([], [])
    assert p.choose((0.0, 0.0), [], jobs, room=1, margin=0.0) == ([], [])


def view(**changes) -> dict:
    base = {
        "mode": "e-scooter", "position": [0.0, 0.0], "car": None, "charging": None, "scooter_xy": None, "energy": 90.0,
        "battery": 50.0, "range_m": 1250.0, "balance": 100.0, "inventory": {}, "left_s": 3600.0, "speed": 6.0,
        "nearest": {
            "charging_station": {"name": "charging_station 1", "xy": [50.0, 0.0], "m": 50},
            "store": {"name": "store 1", "xy": [0.0, 900.0], "m": 900},
            "car_rental": {"name": "car_rental 1", "xy": [0.0, 60.0], "m": 60},
        },
    }  # fmt: skip
    return {**base, **changes}


def test_errands() -> None:
    assert errands.regain(view()) is None
    parked = view(mode="walk", scooter_xy=[1.0, 0.0])
    assert errands.regain(parked) == 'SWITCH(to="e-scooter")'
    assert errands.regain({**parked, "charging": {"target": 80.0, "left_s": 60.0}}) == 'WAIT("charge_done")'
    assert errands.regain(view(mode="walk", scooter_xy=[30.0, 0.0])) == "MOVE(30.00m, 0.00m)"
    assert errands.wants_car(view(), Upkeep()) and not errands.wants_car(view(left_s=600.0), Upkeep())
    assert errands.fetch_car(view()) == "MOVE(0.00m, 60.00m)"
    assert errands.fetch_car(view(position=[0.0, 58.0])) == "RENT_CAR()"
    assert errands.refresh(view(energy=40.0, inventory={"energy_drink": 1}), Upkeep()) == "USE_ENERGY_DRINK()"
    # 100 m to go with a range of 120 m and 40 m to spare: charge first, the store is too far out of the way.
    assert errands.power(view(range_m=120.0, battery=4.8), 100.0) == "MOVE(50.00m, 0.00m)"
    assert errands.power(view(), 100.0) is None
    pack = view(range_m=50.0, inventory={"escooter_battery_pack": 1})
    assert errands.power(pack, 100.0) == "USE_BATTERY_PACK()"
    # 3600 s at 0.085 %/s are 306 %, of which 10 % are there: 296 % or six drinks.
    driving = view(mode="car", car={"at": None, "minutes": 1.0}, energy=10.0)
    assert errands.wanted(driving, Upkeep()) == {"energy_drink": 6}
    assert errands.close_car({**driving, "left_s": 100.0}) == "MOVE(0.00m, 60.00m)"


@pytest.mark.parametrize("size", ["tiny", "small"])
def test_rule_based_courier_earns_far_more_than_random(size: str) -> None:
    rule = [play({"size": size}, seed, "rule") for seed in range(2)]
    luck = [play({"size": size}, seed, "random") for seed in range(2)]
    assert min(net for net, *_ in rule) > 100.0
    assert max(net for net, *_ in luck) < 30.0


def test_quick_start_episodes() -> None:
    rule = [play(QUICK, seed, "rule") for seed in range(8)]
    luck = [play(QUICK, seed, "random") for seed in range(8)]
    assert all(10 <= steps <= 16 and deliveries >= 1 for _, steps, deliveries in rule)
    assert mean(net for net, *_ in rule) > 10.0
    assert mean(net for net, *_ in luck) < 5.0


@needs_reference
def test_first_reference_city(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("AGENTSPEC_CACHE", str(tmp_path))
    net, _, deliveries = play({"map": REFERENCE / "maps" / "small-city-11"}, 0, "rule")
    assert net > 150.0 and deliveries > 25


@pytest.mark.parametrize("style", ["rule_based", "random"])
@pytest.mark.parametrize("options", [QUICK, {"size": "tiny", "max_steps": 40}])
def test_as_reasoners_without_a_model(style: str, options: dict) -> None:
    runner = Runner(AgentSpec.from_data({"reasoning": style}))
    first, again = (runner.run([EpisodeJob(Task("deliverybench", 3, options))])[0] for _ in range(2))
    assert first.status == "completed", first.error
    assert [t.action_text for t in first.transitions] == [t.action_text for t in again.transitions]
    assert first.metrics["llm_calls"] == 0 and all(t.decision.valid for t in first.transitions)


def test_the_expert_is_asked_of_the_environment() -> None:
    assert roles("agentspec/DeliveryBench-v0") == DeliveryBenchEnv.experts and roles("CartPole-v1") == {}
    mine = player("agentspec/DeliveryBench-v0", "rule_based", {"size": "tiny", "city_seed": 3}, random.Random(0))
    assert isinstance(mine, RuleBasedCourier) and mine.city is generate("tiny", 3)
    with pytest.raises(NoPlayer, match="CartPole-v1 has no player 'rule_based'"):
        player("CartPole-v1", "rule_based", {}, random.Random(0))


def test_bagging_pays_under_fair_rules() -> None:
    env = DeliveryBenchEnv(size="tiny")
    earned = {}
    for bagging in (True, False):
        courier, ended = RuleBasedCourier(env.city, Style(bagging=bagging)), False
        _, info = env.reset(seed=0)
        while not ended:
            _, _, terminated, truncated, info = env.step(courier.act(info))
            ended = terminated or truncated
        earned[bagging] = info["net_earnings"]
    assert earned[True] > 100.0 and earned[True] > 2.0 * earned[False]


def test_a_refused_action_is_not_repeated_at_once() -> None:
    env = DeliveryBenchEnv(size="tiny")
    _, info = env.reset(seed=0)
    courier = RuleBasedCourier(env.city)
    action = courier.act(info)
    state = {**info["state"], "error": "no"}
    assert courier.act({**info, "state": state}) == "WAIT(10)" != action


def test_courier_state_survives_a_snapshot() -> None:
    env = DeliveryBenchEnv(size="tiny")
    _, info = env.reset(seed=0)
    courier = RuleBasedCourier(env.city)
    for _ in range(12):
        *_, info = env.step(courier.act(info))
    blob = courier.snapshot()
    other = RuleBasedCourier(env.city)
    other.restore(blob)
    assert other.round == courier.round and other.act(info) == courier.act(info)
    dice = luck({}, random.Random(4))
    blob = dice.snapshot()
    drawn = [dice.act(info) for _ in range(5)]
    dice.restore(blob)
    assert [dice.act(info) for _ in range(5)] == drawn


def test_the_courier_never_sleeps_beside_open_offers() -> None:
    """With two steps left nothing can be delivered; the whole rest of the shift used to be waited away at once."""
    env = DeliveryBenchEnv(size="tiny", max_steps=2)
    _, info = env.reset(seed=1)
    courier = RuleBasedCourier(env.city)
    assert len(info["state"]["offers"]) == 10 and courier.act(info) == "WAIT(60)"
    # Where the number of actions is not limited, nothing comes of waiting in small pieces.
    free = DeliveryBenchEnv(size="tiny", shift_hours=0.02)
    _, info = free.reset(seed=1)
    assert courier.act(info) == "WAIT(72)"


def test_with_few_actions_left_no_car_is_rented() -> None:
    """A car costs two actions and a dollar a minute: of sixteen actions too much, and the menu puts it further back."""
    earned = []
    for seed in range(8):
        env = DeliveryBenchEnv(**QUICK)
        _, info = env.reset(seed=seed)
        courier, ended = RuleBasedCourier(env.city), False
        while not ended:
            assert not any("car" in choice for choice in info["action_schema"].choices)
            _, _, terminated, truncated, info = env.step(courier.act(info))
            ended = terminated or truncated
        earned.append(info["net_earnings"])
    # It was 17 dollars with the earlier, smaller menu, and 11 with the car.
    assert mean(earned) > 15.0
