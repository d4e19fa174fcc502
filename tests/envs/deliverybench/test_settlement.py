"""Stars and money, each number by hand."""

from __future__ import annotations

import pytest

from agentspec.envs.deliverybench.world.bag import Item
from agentspec.envs.deliverybench.world.food import MENU, toward_ambient
from agentspec.envs.deliverybench.world.rules import ORIGINAL
from agentspec.envs.deliverybench.world.settlement import Settlement, settle, star

MENU_BY_NAME = {food.name: food for food in MENU}


def item(name: str, offset: float = 0.0, odour: float = 0.0, damage: int = 0) -> Item:
    """A dish ``offset`` degrees away from its serving temperature."""
    food = MENU_BY_NAME[name]
    return Item(name, food, 0, food.capacity, food.serving + offset, odour, damage)


def graded(*items: Item, duration: float = 600.0, method: str = "call", methods: tuple[str, ...] = ()) -> Settlement:
    """An order of 10 dollars with a limit of 600 s."""
    return settle(
        3, pay=10.0, duration=duration, limit=600.0, methods=methods, method=method, items=items, pick_score=1.0,
        rules=ORIGINAL,
    )  # fmt: skip


@pytest.mark.parametrize(
    "value, stars",
    [(0.0, 5), (1.0, 5), (1.0001, 4), (1.1, 4), (1.11, 3), (1.25, 3), (1.26, 2), (1.5, 2), (1.51, 1)],
)
def test_cutoffs(value: float, stars: int) -> None:
    assert star(value, ORIGINAL.time_cutoffs) == stars


@pytest.mark.parametrize(
    "duration, base, time_star, on_time",
    [
        (600.0, 10.0, 5, True),
        (660.0, 10.0, 4, True),  # up to 60 s late is paid in full
        (800.0, 7.5, 2, False),  # 10 * 600 / 800; ratio 1.33
        (2400.0, 5.0, 1, False),  # never below half
    ],
)
def test_lateness(duration: float, base: float, time_star: int, on_time: bool) -> None:
    result = graded(item("Burger"), duration=duration)
    assert (result.base, result.time_star, result.on_time) == (pytest.approx(base), time_star, on_time)
    assert result.late is (duration > 600.0)


def test_perfect_order() -> None:
    # (1.5 * 5 + 5 + 0.5 * 5) / 3 = 5 stars: bonus 3.
    result = graded(item("Burger"), item("Salad"))
    assert (result.stars, result.bonus, result.paid) == (5, 3.0, 13.0)
    assert result.temp_ok and result.odour_ok and result.damage_ok


def test_wrong_method_and_cold_food() -> None:
    # Burger 16 degrees off: 0.5*1 + 0.2*5 + 0.3*5 = 3.0 -> 3 stars. Wrong method: 1.
    # (1.5*5 + 3 + 0.5*1) / 3 = 3.67 -> 4 stars: bonus 1.5.
    result = graded(item("Burger", offset=-16.0), method="call", methods=("knock",))
    assert (result.food_star, result.method_star, result.stars, result.bonus) == (3, 1, 4, 1.5)
    assert not result.temp_ok


def test_half_rounds_to_even() -> None:
    # 0.5*4 + 0.2*5 + 0.3*5 = 4.5 -> 4; 0.5*5 + 0.2*5 + 0.3*3 = 4.4 -> 4; mean of 4 and 5 is 4.5 -> 4.
    assert graded(item("Burger", offset=5.0)).item_stars == (4,)
    assert graded(item("Noodles", damage=1)).item_stars == (4,)
    assert graded(item("Burger", offset=5.0), item("Burger")).food_star == 4


def test_worst_order_costs_money() -> None:
    # Damage 3 -> 1, 16 degrees off -> 1, odour 0.6 -> 1: item star 1. Time 1, method 1: (1.5 + 1 + 0.5) / 3 = 1: -2.
    awful = item("Salad", offset=16.0, odour=0.6, damage=3)
    result = graded(awful, duration=6000.0, methods=("knock",))
    assert (result.stars, result.bonus, result.paid) == (1, -2.0, 3.0)
    assert not (result.temp_ok or result.odour_ok or result.damage_ok)


def test_smelly_food_and_no_food() -> None:
    result = graded(item("Durian", odour=1.0))
    assert result.odour_ok and result.item_stars == (5,)
    assert graded().food_star == 3


def test_cooling_in_the_open() -> None:
    # 60 -> 22 + 38 / e after 1800 s; nothing happens before it is ready.
    assert toward_ambient(60.0, 22.0, 1 / 1800, 1800.0) == pytest.approx(22.0 + 38.0 * 0.36787944)
    assert toward_ambient(60.0, 22.0, 1 / 1800, -5.0) == 60.0
