"""The bag: physics against the step-by-step definition, and its little language."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agentspec.envs.deliverybench.world.bag import HEAT, ICE, Bag, Item
from agentspec.envs.deliverybench.world.engine import World
from agentspec.envs.deliverybench.world.food import MENU
from agentspec.envs.deliverybench.world.grammar import Refused
from agentspec.envs.deliverybench.world.packing import place
from agentspec.envs.deliverybench.world.rules import ORIGINAL
from agentspec.envs.deliverybench.world.state import OrderState
from tests.envs.deliverybench.helpers import collect, do, refuse, world

FOODS = {food.name: food for food in MENU}


def item(name: str, temp: float | None = None, order: int = 0) -> Item:
    food = FOODS[name]
    return Item(name, food, order, food.capacity, food.serving if temp is None else temp, 1.0 if food.smells else 0.0)


def euler(air: float, items: list[Item], ticks: int) -> tuple[float, list[float], list[float]]:
    """The definition: explicit Euler steps of 0.1 s."""
    temps, odours = [i.temp for i in items], [i.odour for i in items]
    alpha, spread, strongest = 0.1 / 600.0, 0.1 / 900.0, max(odours)
    for _ in range(ticks):
        flow = sum(i.capacity * (t - air) for i, t in zip(items, temps, strict=True)) / 0.4
        temps = [t + alpha * (air - t) for t in temps]
        air += alpha * flow
        odours = [o + spread * (strongest - o) for o in odours]
    return air, temps, odours


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from(sorted(FOODS)), min_size=1, max_size=5), st.integers(1, 3000), st.floats(-10, 60))
def test_closed_form_equals_euler(names: list[str], ticks: int, air: float) -> None:
    bag = Bag(ORIGINAL)
    bag.compartments["B"].air = air
    bag.compartments["B"].items = [item(name) for name in names]
    expected = euler(air, [item(name) for name in names], ticks)
    bag.advance(ticks)
    inside = bag.compartments["B"]
    assert inside.air == pytest.approx(expected[0], abs=1e-6)
    assert [i.temp for i in inside.items] == pytest.approx(expected[1], abs=1e-6)
    assert [i.odour for i in inside.items] == pytest.approx(expected[2], abs=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(1, 5000), min_size=1, max_size=6), st.integers(0, 99))
def test_steps_add_up_and_heat_is_conserved(ticks: list[int], seed: int) -> None:
    names = random.Random(seed).sample(sorted(FOODS), 3)

    def fresh() -> Bag:
        bag = Bag(ORIGINAL)
        bag.compartments["A"].items = [item(name) for name in names]
        return bag

    def heat(bag: Bag) -> float:
        inside = bag.compartments["A"]
        return 0.4 * inside.air + sum(i.capacity * i.temp for i in inside.items)

    slow, fast = fresh(), fresh()
    for n in ticks:
        slow.advance(slow.tick + n)
    fast.advance(sum(ticks))
    assert [i.temp for i in slow.items()] == pytest.approx([i.temp for i in fast.items()], abs=1e-9)
    assert heat(fast) == pytest.approx(heat(fresh()), abs=1e-9)


def test_one_item_by_hand() -> None:
    # Curry, C = 1.1, 60 deg, air 23: equilibrium (0.4 * 23 + 1.1 * 60) / 1.5 = 50.1333...
    bag = Bag(ORIGINAL)
    bag.compartments["A"].items = [item("Curry")]
    bag.advance(1)
    curry, inside = bag.compartments["A"].items[0], bag.compartments["A"]
    assert curry.temp == pytest.approx(60.0 - 37.0 / 6000.0)
    assert inside.air == pytest.approx(23.0 + 1.1 * 37.0 / 0.4 / 6000.0)
    bag.advance(10_000_000)
    assert (curry.temp, inside.air) == pytest.approx((75.2 / 1.5, 75.2 / 1.5))
    bag.advance(5)
    assert bag.tick == 10_000_000


def test_empty_compartments_and_packs() -> None:
    bag = Bag(ORIGINAL)
    bag.advance(1000)
    assert [c.air for c in bag.compartments.values()] == [23.0] * 4
    bag.insert_pack("A", ICE)
    bag.insert_pack("A", HEAT)
    first = bag.compartments["A"].items[0]
    bag.advance(2000)
    bag.insert_pack("A", ICE)
    assert [i.name for i in bag.compartments["A"].items] == [HEAT, ICE]
    assert first not in bag.compartments["A"].items
    bag.insert_pack("C", ICE)
    bag.insert_pack("C", ICE)
    # Replacing the only pack empties the compartment for a moment: its air is ambient again.
    assert bag.compartments["C"].air == 22.0
    bag.remove({id(i) for i in bag.items()})
    assert [c.air for c in bag.compartments.values()] == [22.0, 23.0, 22.0, 23.0]


def test_shaking() -> None:
    bag = Bag(ORIGINAL)
    sushi, tea = item("Sushi"), item("Tea")
    bag.compartments["A"].items = [sushi, tea]
    bag.insert_pack("A", ICE)
    for _ in range(5):
        bag.shake()
    assert (sushi.damage, tea.damage) == (3, 0)


def hands(**orders: list[str]) -> dict[int, OrderState]:
    """Orders with food in the hand: ``hands(o3=["Tea"])``."""
    result = {}
    for key, names in orders.items():
        number = int(key[1:])
        items = [item(name, order=number) for name in names]
        result[number] = OrderState(None, 0, 0.0, 0, items, list(items))  # type: ignore[arg-type]
    return result


def layout(bag: Bag) -> dict[str, list[str]]:
    return {label: [i.name for i in c.items] for label, c in bag.compartments.items() if c.items}


@pytest.mark.parametrize("loose", [True, False])
def test_placing(loose: bool) -> None:
    bag, orders = Bag(ORIGINAL), hands(o3=["Tea", "Cake", "Sushi"], o14=["Soup"])
    assert place(bag, orders, "Order 3: 1,3 -> a; 2->B and ORDER 14: 1 -> A", loose) == 4
    assert layout(bag) == {"A": ["Tea", "Sushi", "Soup"], "B": ["Cake"]}
    assert not any(order.pending for order in orders.values())


@pytest.mark.parametrize("loose", [True, False])
def test_numbers_are_renewed_after_partial_placement(loose: bool) -> None:
    bag, orders = Bag(ORIGINAL), hands(o3=["Tea", "Cake", "Sushi"])
    place(bag, orders, "1 -> C", loose)
    place(bag, orders, "1,2 -> D", loose)
    assert layout(bag) == {"C": ["Tea"], "D": ["Cake", "Sushi"]}


@pytest.mark.parametrize("loose", [True, False])
def test_moves_come_first_and_highest_number_first(loose: bool) -> None:
    bag, orders = Bag(ORIGINAL), hands(o1=["Tea"])
    bag.compartments["A"].items = [item("Soup"), item("Cake"), item("Fries")]
    place(bag, orders, "order 1: 1 -> B; A.1, A.3 -> B", loose)
    assert layout(bag) == {"A": ["Cake"], "B": ["Fries", "Soup", "Tea"]}
    place(bag, hands(o2=["Pizza"]), "order 2: A.1 -> C; 1 -> A", loose)
    assert bag.compartments["A"].air == 22.0


@pytest.mark.parametrize("loose", [True, False])
@pytest.mark.parametrize(
    "command, code",
    [
        ("1 -> A", "BAG_NEED_PREFIX"),
        ("order 9: 1 -> A", "BAG_NO_MATCH"),
        ("order 3: 1 -> E", "BAG_BAD_COMP"),
        ("order 3: 1 -> ", "BAG_BAD_COMP"),
        ("order 3: 1.5 -> A", "BAG_BAD_COMP"),
        ("order 3: A.1 -> B; 1 -> A", "BAG_NO_SLOT"),
        ("order 3: A.x -> B", "BAG_NO_SLOT"),
        ("order 3: 1,4 -> A", "BAG_NO_ITEM"),
    ],
)
def test_errors_change_nothing(command: str, code: str, loose: bool) -> None:
    bag, orders = Bag(ORIGINAL), hands(o3=["Tea", "Cake"], o4=["Soup"])
    with pytest.raises(Refused) as refusal:
        place(bag, orders, command, loose)
    assert refusal.value.code == code and refusal.value.message
    assert layout(bag) == {} and len(orders[3].pending) == 2


def test_loose_reading() -> None:
    # A block without any valid number places nothing and succeeds; a stray number takes food out of the hand.
    bag, orders = Bag(ORIGINAL), hands(o3=["Tea", "Cake"])
    assert place(bag, orders, "order 3: 4 -> A", True) == 0
    assert place(bag, orders, "put it anywhere", True) == 0
    assert len(orders[3].pending) == 2
    place(bag, orders, "1 & 2 -> A", True)
    assert layout(bag) == {} and orders[3].pending == []


@pytest.mark.parametrize(
    "command, code",
    [
        ("put it anywhere", "BAG_SYNTAX"),
        ("1 & 2 -> A", "BAG_SYNTAX"),
        ("1 -> A; 2", "BAG_SYNTAX"),
        ("1 -> A; 1 -> B", "BAG_TWICE"),
        ("4 -> A", "BAG_NO_ITEM"),
    ],
)
def test_strict_reading(command: str, code: str) -> None:
    bag, orders = Bag(ORIGINAL), hands(o3=["Tea", "Cake"])
    with pytest.raises(Refused) as refusal:
        place(bag, orders, command, False)
    assert refusal.value.code == code
    assert len(orders[3].pending) == 2


def bagged(rules: str) -> World:
    """A courier with order 1's food in compartment A."""
    w = world(rules)
    collect(w, 1)
    n = len(w.state.orders[1].pending)
    do(w, f'PLACE_FOOD_IN_BAG(bag_cmd="order 1: {",".join(str(i + 1) for i in range(n))} -> A")')
    return w


@pytest.mark.parametrize("rules", ["original", "fair"])
def test_bagged_food_changes_and_leaves_with_its_order(rules: str) -> None:
    w = bagged(rules)
    order = w.state.orders[1]
    before = [i.temp for i in order.items]
    do(w, "WAIT(300)")
    assert w.look().bag.compartments["A"].items == order.items
    assert any(not math.isclose(a, i.temp) for a, i in zip(before, order.items, strict=True))
    w.state.position = order.offer.dropoff.anchor
    refuse(w, 'DROP_OFF(1, "throw")', "DO_BAD_METHOD")
    outcome = do(w, 'DROP_OFF(1, "Leave at-door")')
    assert [s.order_id for s in outcome.settlements] == [1]
    assert list(w.state.bag.items()) == [] and w.state.bag.compartments["A"].air == 22.0


def test_packs_from_the_inventory() -> None:
    w = world("fair")
    refuse(w, "USE_ICE_PACK()", "PK_COMP")
    refuse(w, 'USE_ICE_PACK(comp="1")', "PK_COMP")
    refuse(w, 'USE_ICE_PACK(comp="Z")', "PK_NONE")
    w.state.inventory.update(ice_pack=1, heat_pack=1)
    refuse(w, 'USE_ICE_PACK(comp="Z")', "PK_BAD_COMP")
    do(w, 'USE_ICE_PACK(comp="a2")')
    do(w, 'USE_HEAT_PACK("D")')
    assert w.state.inventory == {"ice_pack": 0, "heat_pack": 0}
    assert layout(w.state.bag) == {"A": [ICE], "D": [HEAT]}
    refuse(w, "PLACE_FOOD_IN_BAG()", "BAG_EMPTY")
