"""The menu: few, distinct, stable and legal choices, each one native call, and all that earns among them."""

from __future__ import annotations

import random

import pytest

from agentspec.envs.deliverybench.city.generate import generate
from agentspec.envs.deliverybench.env import DeliveryBenchEnv
from agentspec.envs.deliverybench.expert.courier import RuleBasedCourier
from agentspec.envs.deliverybench.expert.matching import match
from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.cards import OfferCards, describe
from agentspec.envs.deliverybench.view.choices import KINDS, MAX_ORDERS, best_offers, open_stops, rate
from agentspec.envs.deliverybench.view.menu import MAX_CHOICES, MORE, Option, options, pages
from agentspec.envs.deliverybench.world.engine import World


def view_of(world: World) -> dict:
    return describe(world, OfferCards(world.book))


def texts(world: World) -> list[str]:
    """The first page."""
    return [option.text for option in pages(view_of(world))[0]]


def everything(world: World) -> set[str]:
    return {option.text for option in options(view_of(world))}


def take(world: World, text: str) -> None:
    call = next(option.call for option in options(view_of(world)) if option.text == text)
    assert world.step(call).ok, (text, call)


def stand(world: World, kind: str) -> None:
    world.state.position = world.city.pois_of(kind)[0].anchor


def test_one_order_from_offer_to_delivery() -> None:
    world = World(generate("tiny", 0), seed=0)
    first = texts(world)
    assert first[-2:] == ["wait 1 minute", MORE.text]
    accept = next(text for text in first if text.startswith("accept order "))
    number = int(accept.split()[-1])
    take(world, accept)
    restaurant = world.book[number].pickup.name
    take(world, f"hurry to {restaurant}")
    if f"wait for order {number}" in texts(world):
        take(world, f"wait for order {number}")
    take(world, f"pick up order {number}")
    # With food in the hand it is packed before the courier rides on.
    assert not any("drop-off" in text for text in everything(world))
    take(world, f"bag order {number}")
    take(world, f"go to drop-off of order {number}")
    (delivery,) = [t for t in texts(world) if t.startswith(f"deliver order {number}")]
    assert texts(world)[0] == delivery
    take(world, delivery)
    assert len(world.state.settlements) == 1 and world.state.settlements[0].method_star == 5


def test_best_offers_pay_most_for_the_way_they_add() -> None:
    world = World(generate("small", 0), seed=0)
    view = view_of(world)
    shown = best_offers(view, 10)
    rates = [rate(offer, [view["position"]]) for offer in shown]
    assert rates == sorted(rates, reverse=True)
    # With half a minute left nothing can be cooked, fetched and delivered.
    assert best_offers({**view, "left_s": 30.0}, 10) == []


def test_an_offer_on_the_way_counts_as_one() -> None:
    # 1,000 m east to the restaurant and 1,000 m on; an open order leads to the same two places.
    offer = {"pay": 8.0, "pickup_xy": [1000.0, 0.0], "dropoff_xy": [2000.0, 0.0]}
    alone = rate(offer, [[0.0, 0.0]])
    view = {"orders": [{"status": "ready", "pickup_xy": [1000.0, 0.0], "dropoff_xy": [2000.0, 0.0]}]}
    together = rate(offer, [[0.0, 0.0], *open_stops(view)])
    # (8 + 2) dollars for 2,000 m, or for no way at all; 100 m are added to both.
    assert alone == pytest.approx(10.0 / 2100.0) and together == pytest.approx(10.0 / 100.0)


def test_several_orders_can_be_taken_at_once_until_the_bag_is_full_enough() -> None:
    world = World(generate("tiny", 0), seed=0)
    pair = next(t for t in texts(world) if t.startswith("accept orders "))
    take(world, pair)
    assert len(world.state.orders) == 2 and pair == f"accept orders {', '.join(map(str, world.state.orders))}"
    while len(world.state.orders) < MAX_ORDERS:
        take(world, next(t for t in everything(world) if t.startswith("accept order ")))
    assert not any(t.startswith("accept") for t in everything(world))


def test_offers_that_would_exceed_the_limit_are_not_made_in_pairs() -> None:
    world = World(generate("tiny", 0), seed=0)
    world.step(f"ACCEPT_ORDER({world.state.pool[: MAX_ORDERS - 1]})")
    offered = [t for t in everything(world) if t.startswith("accept")]
    assert offered and not any(t.startswith("accept orders") for t in offered)


def test_charging_to_a_level() -> None:
    world = World(generate("tiny", 0), seed=0)
    assert "go to charger" not in texts(world) and "go to charger" in everything(world)
    world.state.scooter.battery = 30.0
    assert "go to charger" in texts(world)
    take(world, "go to charger")
    levels = {"charge to 40%", "charge to 60%", "charge to 80%", "charge to 100%"}
    assert levels <= set(texts(world))
    take(world, "charge to 60%")
    assert {"wait for charging", "ride scooter"} <= set(texts(world))
    take(world, "wait for charging")
    assert world.state.scooter.battery == pytest.approx(60.0) and "wait for charging" not in everything(world)
    take(world, "ride scooter")
    assert {"charge to 80%", "charge to 100%"} <= everything(world) and "charge to 60%" not in everything(world)


def test_rest_drinks_and_packs() -> None:
    world = World(generate("tiny", 0), seed=0)
    world.state.energy = 30.0
    assert {"go to rest area", "go to store"} <= set(texts(world))
    stand(world, "rest_area")
    take(world, "rest to 80%")
    assert world.state.energy == pytest.approx(80.0)
    stand(world, "store")
    goods = ("energy drink", "battery pack", "ice pack", "heat pack")
    for name in goods:
        take(world, f"buy {name}")
    assert set(world.state.inventory.values()) == {1}
    world.state.energy, world.state.scooter.battery = 40.0, 10.0
    assert {"use energy drink", "use battery pack"} <= set(texts(world))
    for text in ("use energy drink", "use battery pack", "put ice pack into B", "put heat pack into A"):
        take(world, text)
    assert (
        world.state.energy == 90.0 and world.state.scooter.battery == 100.0 and not any(world.state.inventory.values())
    )


def test_a_car_is_rented_parked_and_returned() -> None:
    world = World(generate("tiny", 0), seed=0)
    assert "go to car rental" in texts(world)
    take(world, "go to car rental")
    take(world, "rent car")
    assert world.state.mode == "car" and "rent car" not in everything(world)
    take(world, "leave vehicle, go on foot")
    assert "drive car" in texts(world)
    take(world, "drive car")
    take(world, "return car")
    assert world.state.car is None
    # A quarter of an hour before the end the rent is not worth its place on the first page.
    world.state.tick = world.shift_ticks - 8_000
    assert "rent car" not in texts(world) and "rent car" in everything(world)


def test_the_bus() -> None:
    world = World(generate("tiny", 0), seed=0)
    assert "go to bus stop" in everything(world)
    line = world.timetable
    world.state.position = line.stops[0]
    assert "wait for bus" in everything(world)
    take(world, "wait for bus")
    other = line.names[1]
    take(world, f"take bus to {other}")
    assert world.state.position == pytest.approx(line.stops[1], abs=1.0)


def test_a_scooter_left_behind_can_be_fetched() -> None:
    world = World(generate("tiny", 0), seed=0)
    take(world, "leave vehicle, go on foot")
    world.step("MOVE(0m, 40m)")
    take(world, "go to scooter")
    take(world, "ride scooter")


def test_both_paces_are_offered_the_gentle_one_first_with_fragile_food() -> None:
    world = World(generate("tiny", 0), seed=0)
    number = next(n for n in world.state.pool if any(food.fragile for food in world.book[n].foods))
    world.step(f"ACCEPT_ORDER([{number}])")
    restaurant = world.book[number].pickup.name
    assert f"hurry to {restaurant}" in texts(world) and f"go to {restaurant}" in everything(world)
    world.step(next(o.call for o in options(view_of(world)) if o.text == f"hurry to {restaurant}"))
    world.step("WAIT(420)")
    take(world, f"pick up order {number}")
    take(world, f"bag order {number}")
    first = texts(world)
    assert f"go to drop-off of order {number}" in first and f"hurry to drop-off of order {number}" not in first
    assert f"hurry to drop-off of order {number}" in everything(world)


@pytest.mark.parametrize("seed", range(3))
def test_every_option_of_a_random_episode_is_sensible(seed: int) -> None:
    env = DeliveryBenchEnv(size="tiny", city_seed=seed, action_mode="menu", observation="compact", max_steps=40)
    _, info = env.reset(seed=seed)
    rng, ended = random.Random(seed), False
    while not ended:
        choices = info["action_schema"].choices
        assert 1 <= len(choices) <= MAX_CHOICES and len({c.casefold() for c in choices}) == len(choices)
        assert all(len(choice) <= 40 for choice in choices)
        # Each one succeeds from here, except that a way may be longer than battery or energy last.
        here = env.snapshot()
        for choice in choices:
            outcome = env.step(choice)[4]
            assert outcome["error_code"] in ("", "MV_DEPLETED", "MV_COLLAPSED"), (choice, outcome["error"])
            env.restore(here)
        assert [option.text for option in env.menu] == list(choices) and {o.kind for o in env.menu} <= set(KINDS)
        _, _, terminated, truncated, info = env.step(rng.choice(choices))
        ended = terminated or truncated


def test_more_choices_turns_pages_and_takes_no_time() -> None:
    env = DeliveryBenchEnv(size="small", action_mode="menu", think_time={"call": 2.0})
    _, info = env.reset(seed=0)
    first, seen, turns = info["action_schema"].choices, [], 0
    while not turns or info["action_schema"].choices != first:
        seen += info["action_schema"].choices[:-1]
        env.deliberate(0, 0)
        _, reward, *_, info = env.step(MORE.text)
        assert reward == 0.0 and info["seconds"] == 0.0 and not info["invalid"] and info["state"]["clock_s"] == 0.0
        turns += 1
    # Every choice once, on as many pages as turns.
    assert len(seen) == len(set(seen)) == len(options(info["state"])) and turns >= 2
    assert len(first) <= 8
    # Thinking about it is charged like any other decision, and another action leads back to the first page.
    env.step(MORE.text)
    *_, info = env.step("WAIT(60)")
    assert info["state"]["clock_s"] == 2.0 + 2.0 + 60.0
    assert info["action_schema"].choices == tuple(o.text for o in pages(info["state"])[0])


def test_the_page_belongs_to_the_state() -> None:
    env = DeliveryBenchEnv(size="small", action_mode="menu", observation="compact")
    env.reset(seed=0)
    observation, *_, info = env.step(MORE.text)
    blob = env.snapshot()
    env.step("wait 1 minute")
    env.restore(blob)
    again, told = env.observe()
    assert again["text"] == observation["text"] and told["action_schema"].choices == info["action_schema"].choices


def test_turning_pages_for_ever_ends() -> None:
    env = DeliveryBenchEnv(size="tiny", action_mode="menu", rules="original")
    env.reset(seed=0)
    for _ in range(199):
        assert not env.step(MORE.text)[3]
    assert env.step(MORE.text)[3]


def test_texts_stay_the_same_from_step_to_step() -> None:
    """Of two menus a minute apart with nothing done in between the same choices have the same texts."""
    env = DeliveryBenchEnv(size="small", action_mode="menu")
    _, info = env.reset(seed=2)
    *_, info = env.step(next(c for c in info["action_schema"].choices if c.startswith("accept orders")))
    before = {option.call: option.text for option in options(info["state"]) if option.kind != "wait"}
    *_, info = env.step("wait 1 minute")
    after = {option.call: option.text for option in options(info["state"]) if option.kind != "wait"}
    common = before.keys() & after.keys()
    assert len(common) >= 10 and all(before[call] == after[call] for call in common)


def test_the_expert_earns_through_the_menu_what_it_earns_natively() -> None:
    earned = {}
    for mode in ("native", "menu"):
        env = DeliveryBenchEnv(size="small", city_seed=0, action_mode=mode, shift_hours=0.5)
        _, info = env.reset(seed=0)
        courier, ended = RuleBasedCourier(env.city), False
        while not ended:
            _, _, terminated, truncated, info = env.step(courier.act(info))
            assert not info["invalid"], info["error"]
            ended = terminated or truncated
        earned[mode] = info["net_earnings"]
    # Before the menu had all that earns, it was a sixth.
    assert earned["native"] > 80.0 and earned["menu"] >= 0.8 * earned["native"]


@pytest.mark.parametrize(
    ("call", "taken", "text"),
    [
        ("MOVE(10.00m, -3.50m)", (), "hurry to restaurant 1"),
        ("ACCEPT_ORDER([4, 7, 9])", (4, 7, 9), "accept orders 7, 9"),
        ("ACCEPT_ORDER([4, 9])", (4, 9), "accept order 4"),
        ('BUY(items=[{"item_id": "energy_drink", "qty": 3}])', (), "buy energy drink"),
        ("CHARGE(target_pct=73)", (), "charge to 80%"),
        ("WAIT(50)", (), "wait 1 minute"),
        ("WAIT(900)", (), "wait 5 minutes"),
        ("VIEW_BAG()", (), "wait 1 minute"),
    ],
)
def test_native_calls_find_their_choice(call: str, taken: tuple[int, ...], text: str) -> None:
    menu = [
        Option("hurry to restaurant 1", 'MOVE(10.00m, -3.50m, pace="accel")', "hurry"),
        Option("accept order 4", "ACCEPT_ORDER([4])", "accept"),
        Option("accept orders 7, 9", "ACCEPT_ORDER([7, 9])", "accept"),
        Option("buy energy drink", 'BUY(item_id="energy_drink", qty=1)', "buy"),
        Option("charge to 100%", "CHARGE(target_pct=100)", "charge"),
        Option("charge to 80%", "CHARGE(target_pct=80)", "charge"),
        Option("charge to 60%", "CHARGE(target_pct=60)", "charge"),
        Option("wait 1 minute", "WAIT(60)", "wait"),
        Option("wait 5 minutes", "WAIT(300)", "wait"),
    ]
    assert match(call, menu, taken) == text


def test_bag_command_keeps_hot_and_cold_apart_and_smelly_food_alone() -> None:
    bag = {label: {"air": 23.0, "items": []} for label in "ABCD"}
    order = {"id": 3, "hand": ["Burger", "Salad", "Fries", "Popsicle", "Durian"]}
    # Hot 60 with hot 60 into A, cold 5 into B, frozen -12 into C, smelly durian (23) into the empty D.
    assert calls.bag({"bag": bag}, [order]) == 'PLACE_FOOD_IN_BAG(bag_cmd="order 3: 1,3 -> A; 2 -> B; 4 -> C; 5 -> D")'


def test_food_in_the_hand_is_bagged_before_anything_moves() -> None:
    env = DeliveryBenchEnv(size="tiny", action_mode="menu")
    _, info = env.reset(seed=0)
    while not any(order["hand"] for order in info["state"]["orders"]):
        texts = info["action_schema"].choices
        ways = tuple(f"{verb} to restaurant" for verb in ("go", "hurry"))
        wanted = [t for t in texts if t.startswith(("pick up", "wait for", *ways, "accept order "))]
        *_, info = env.step((wanted or texts)[0])
    choices = info["action_schema"].choices
    assert choices[0].startswith("bag order") and not any(c.startswith(("go to", "hurry to")) for c in choices)
    *_, info = env.step(choices[0])
    assert not info["invalid"] and any("drop-off" in c for c in info["action_schema"].choices)


def test_handover_follows_the_note() -> None:
    card = {"id": 1, "dropoff_xy": [1.0, 2.0], "handoff_xy": [5.0, 6.0], "note": ""}
    assert calls.handover(card) == ("leave_at_door", [1.0, 2.0])
    assert calls.handover({**card, "note": "The bell is broken, so knock."})[0] == "knock"
    hand = {**card, "note": "I am waiting outside and will take it from you."}
    assert calls.handover(hand) == ("hand_to_customer", [5.0, 6.0])
    assert calls.handover({**hand, "handoff_xy": None}) == ("leave_at_door", [1.0, 2.0])


def test_calls_are_written_as_the_grammar_wants_them() -> None:
    assert calls.move((1.0, -2.5)) == "MOVE(1.00m, -2.50m)"
    assert calls.move((1.0, -2.5), "accel") == 'MOVE(1.00m, -2.50m, pace="accel")'
    assert calls.wait(61.23) == "WAIT(61.3)" and calls.wait(60.0) == "WAIT(60)"
    assert calls.accept([1, 2]) == "ACCEPT_ORDER([1, 2])" and calls.pick_up([4]) == "PICKUP(orders=[4])"
    assert calls.prep_seconds(["Popsicle", "Sushi"]) == 420.0
    assert calls.numbers_in('MOVE(1.00m, -2.50m, pace="accel")') == [1.0, -2.5]
