"""Settlement: what a delivered order pays and how many stars it earns.

Three grades from 1 to 5 are combined: time (elapsed over limit), food (temperature, odour and damage of each item) and
method (did the hand-over match the customer's note). The wage is paid in full up to a grace period after the deadline
and shrinks with lateness afterwards; five and four stars add a bonus, one star or less costs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from agentspec.envs.deliverybench.world.bag import Item
from agentspec.envs.deliverybench.world.rules import Rules


@dataclass(frozen=True, slots=True)
class Settlement:
    """One delivered order. Times in s, money in dollars, deltas in deg C; the tuples run over the order's items.

    ``on_time`` allows the grace period, ``late`` (a metric of the recorder) does not.
    """

    order_id: int
    duration: float
    limit: float
    method: str
    stars: int
    time_star: int
    food_star: int
    method_star: int
    base: float
    bonus: float
    on_time: bool
    late: bool
    temp_ok: bool
    odour_ok: bool
    damage_ok: bool
    item_stars: tuple[int, ...]
    temp_deltas: tuple[float, ...]
    odours: tuple[float, ...]
    damages: tuple[int, ...]
    pick_score: float

    @property
    def paid(self) -> float:
        """Base wage plus bonus (dollars; can be negative)."""
        return self.base + self.bonus


def settle(
    order_id: int,
    *,
    pay: float,
    duration: float,
    limit: float,
    methods: Sequence[str],
    method: str,
    items: Sequence[Item],
    pick_score: float,
    rules: Rules,
) -> Settlement:
    """Grade and price one delivery (spec: benchmark settlement with default parameters).

    Args:
        pay: full base wage. duration: seconds since acceptance. limit: seconds allowed.
        methods: hand-overs the note allows (empty = all). method: the one used. items: the order's food as delivered.
    """
    on_time = duration <= limit + rules.grace
    base = pay if on_time else pay * max(rules.late_floor, limit / duration)
    time_star = star(duration / limit, rules.time_cutoffs)
    foods = [item for item in items if item.food is not None]
    deltas = tuple(abs(item.temp - item.food.serving) for item in foods if item.food)
    stars = tuple(_item_star(item, delta, rules) for item, delta in zip(foods, deltas, strict=True))
    food_star = _clamp(round(sum(stars) / len(stars)), 1) if stars else 3
    method_star = 5 if not methods or method in methods else 1
    overall = _clamp(round((1.5 * time_star + food_star + 0.5 * method_star) / 3.0), 0)
    return Settlement(
        order_id=order_id,
        duration=duration,
        limit=limit,
        method=method,
        stars=overall,
        time_star=time_star,
        food_star=food_star,
        method_star=method_star,
        base=base,
        bonus=rules.bonus[overall],
        on_time=on_time,
        late=duration > limit,
        temp_ok=all(delta <= rules.temp_ok for delta in deltas),
        odour_ok=all(item.odour <= rules.odour_ok for item in foods if item.food and not item.food.smells),
        damage_ok=all(item.damage < rules.damage_fail for item in foods),
        item_stars=stars,
        temp_deltas=deltas,
        odours=tuple(item.odour for item in foods),
        damages=tuple(item.damage for item in foods),
        pick_score=pick_score,
    )


def star(value: float, cutoffs: Sequence[float]) -> int:
    """5 up to the first cutoff, one less for each cutoff passed, 1 beyond the last."""
    for stars, cutoff in zip((5, 4, 3, 2), cutoffs, strict=True):
        if value <= cutoff:
            return stars
    return 1


def _item_star(item: Item, delta: float, rules: Rules) -> int:
    assert item.food is not None
    temp = star(delta, rules.temp_cutoffs)
    odour = 5 if item.food.smells else star(item.odour, rules.odour_cutoffs)
    damage = rules.damage_stars[min(item.damage, len(rules.damage_stars) - 1)]
    w_temp, w_odour, w_damage = rules.item_weights
    return _clamp(round(w_temp * temp + w_odour * odour + w_damage * damage), 1)


def _clamp(value: int, low: int) -> int:
    return max(low, min(5, value))
