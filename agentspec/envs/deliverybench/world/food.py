"""The menu: what restaurants cook, and how food changes temperature before it reaches the bag.

Each dish has a serving temperature (deg C), a heat capacity (relative to one kg of water or so; only ratios matter), a
preparation time (s), whether it smells (strong-odour dishes taint their bag compartment) and whether shaking harms it.
The order of the menu matters: orders draw from it by position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

HOT, COLD, FROZEN, AMBIENT = "HOT", "COLD", "FROZEN", "AMBIENT"


@dataclass(frozen=True, slots=True)
class Food:
    """One dish: facts only. ``index`` is its position in `MENU`."""

    index: int
    name: str
    category: str
    smells: bool
    fragile: bool
    prep: int
    serving: float
    capacity: float


# name, category, smells, fragile (motion-sensitive), preparation (s), serving temperature (deg C), heat capacity
_ROWS: tuple[tuple[str, str, bool, bool, int, float, float], ...] = (
    ("Burger", HOT, False, False, 300, 60.0, 1.05),
    ("Fries", HOT, False, False, 210, 60.0, 0.95),
    ("Noodles", HOT, False, True, 300, 60.0, 1.00),
    ("Coffee", HOT, True, False, 180, 65.0, 1.15),
    ("Salad", COLD, False, True, 240, 5.0, 1.10),
    ("Sushi", COLD, False, True, 420, 5.0, 1.05),
    ("IceCream", FROZEN, False, False, 60, -12.0, 0.90),
    ("FrozenYogurt", FROZEN, False, False, 60, -9.0, 0.95),
    ("Soup", HOT, False, True, 180, 65.0, 1.20),
    ("Cake", AMBIENT, False, True, 120, 23.0, 0.85),
    ("Sandwich", AMBIENT, False, False, 240, 23.0, 0.90),
    ("Durian", AMBIENT, True, True, 120, 23.0, 0.90),
    ("Pizza", HOT, False, False, 360, 60.0, 1.10),
    ("Curry", HOT, False, True, 420, 60.0, 1.10),
    ("StinkyTofu", HOT, True, True, 300, 60.0, 1.05),
    ("Tea", HOT, False, False, 180, 65.0, 1.10),
    ("PokeBowl", COLD, False, True, 300, 5.0, 1.05),
    ("Milkshake", COLD, False, False, 150, 5.0, 1.00),
    ("Popsicle", FROZEN, False, False, 30, -12.0, 0.85),
    ("IceCreamCake", FROZEN, False, True, 120, -12.0, 0.92),
    ("Donut", AMBIENT, False, False, 120, 23.0, 0.88),
    ("BlueCheese", AMBIENT, True, False, 60, 23.0, 0.90),
)

MENU: tuple[Food, ...] = tuple(Food(i, *row) for i, row in enumerate(_ROWS))


def longest_prep(foods: tuple[Food, ...]) -> int:
    """Seconds after acceptance until an order of these foods is ready (0 for no food)."""
    return max((food.prep for food in foods), default=0)


def toward_ambient(temperature: float, ambient: float, rate: float, seconds: float) -> float:
    """Temperature (deg C) after ``seconds`` in the open: exponential approach to ``ambient`` at ``rate`` per second."""
    return ambient + (temperature - ambient) * math.exp(-rate * max(0.0, seconds))
