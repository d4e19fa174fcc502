"""The insulated bag: four compartments whose air and contents exchange heat and smell.

Within a compartment every item is coupled to the air, and the air to every item; nothing is lost to the outside. Warm
things keep each other warm, an ice pack cools its neighbours, smelly food taints them. The original integrates this
ten times a second with explicit Euler steps; for constant contents those steps have a closed form, so any number of
ticks costs the same:

    S = sum C_i,  M = sum C_i T_i / S,  D = T_air - M
    D_n = D_0 (1 - a (1 + S / C_air))^n,   C_air T_air + S M is conserved,   (T_i - M)_n = (T_i - M)_0 (1 - a)^n

with a = min(0.5, tick / 600 s). Smell moves towards the strongest in the compartment, (1 - a')^n of the gap staying.
The bag evolves lazily: it is brought up to date when its contents change or somebody looks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from agentspec.envs.deliverybench.world.food import Food
from agentspec.envs.deliverybench.world.rules import Rules

LABELS = "ABCD"
ICE, HEAT = "Ice Pack", "Heat Pack"
MAX_DAMAGE = 3


@dataclass(slots=True, eq=False)
class Item:
    """A dish of an order, or a pack (``food`` None). ``temp`` in deg C, ``odour`` 0..1, ``damage`` 0..3.

    ``ready_at`` and ``picked_at`` are the ticks at which the order was ready and picked up. Compared by identity: two
    equal portions are two items.
    """

    name: str
    food: Food | None
    order_id: int
    capacity: float
    temp: float
    odour: float = 0.0
    damage: int = 0
    ready_at: int = 0
    picked_at: int = 0

    def copy(self) -> Item:
        """An independent item in the same state."""
        return Item(
            self.name,
            self.food,
            self.order_id,
            self.capacity,
            self.temp,
            self.odour,
            self.damage,
            self.ready_at,
            self.picked_at,
        )

    def equals(self, other: Item) -> bool:
        """Whether two dishes agree in every property (the original compares food this way)."""
        return (
            self.food is other.food
            and self.temp == other.temp
            and self.odour == other.odour
            and self.damage == other.damage
            and self.ready_at == other.ready_at
            and self.picked_at == other.picked_at
        )


@dataclass(slots=True)
class Compartment:
    """Air temperature (deg C) and the items inside, in the order they were put in."""

    air: float
    items: list[Item] = field(default_factory=list)


class Bag:
    """Four compartments A to D and the tick up to which they have evolved."""

    __slots__ = ("compartments", "rules", "tick")

    def __init__(self, rules: Rules, tick: int = 0) -> None:
        self.rules = rules
        self.tick = tick
        self.compartments = {label: Compartment(rules.first_air) for label in LABELS}

    def advance(self, tick: int) -> None:
        """Bring air, temperatures and smells up to ``tick``; a tick in the past does nothing."""
        ticks, self.tick = tick - self.tick, max(tick, self.tick)
        if ticks <= 0:
            return
        for compartment in self.compartments.values():
            if compartment.items:
                _exchange_heat(compartment, ticks, self.rules)
                _spread_odour(compartment.items, ticks, self.rules)

    def items(self) -> Iterator[Item]:
        """All items, compartment by compartment."""
        for compartment in self.compartments.values():
            yield from compartment.items

    def remove(self, doomed: set[int]) -> None:
        """Take out the items with these ``id()``s; a compartment that becomes empty fills with ambient air."""
        for compartment in self.compartments.values():
            kept = [item for item in compartment.items if id(item) not in doomed]
            if len(kept) != len(compartment.items):
                compartment.items = kept
                if not kept:
                    compartment.air = self.rules.ambient

    def insert_pack(self, label: str, name: str) -> None:
        """Put an ice or heat pack into a compartment, in place of an older one of its kind.

        Raises:
            KeyError: no compartment of that label.
        """
        temperature, capacity = self.rules.ice_pack if name == ICE else self.rules.heat_pack
        self.remove({id(item) for item in self.compartments[label].items if item.name == name})
        self.compartments[label].items.append(Item(name, None, -1, capacity, temperature))

    def shake(self) -> None:
        """One more damage level for every fragile dish in the bag (a hasty move)."""
        for item in {id(item): item for item in self.items()}.values():
            if item.food is not None and item.food.fragile:
                item.damage = min(MAX_DAMAGE, item.damage + 1)

    def detach(self) -> None:
        """Replace every item by a copy: whoever else holds one keeps it as it is now."""
        copies: dict[int, Item] = {}
        for compartment in self.compartments.values():
            compartment.items = [copies.setdefault(id(item), item.copy()) for item in compartment.items]


def _exchange_heat(compartment: Compartment, ticks: int, rules: Rules) -> None:
    items = compartment.items
    alpha = min(0.5, rules.bag_rate / rules.ticks_per_second)
    total = sum(item.capacity for item in items)
    mean = sum(item.capacity * item.temp for item in items) / total
    gap = compartment.air - mean
    heat = rules.air_capacity * compartment.air + total * mean
    gap *= (1.0 - alpha * (1.0 + total / rules.air_capacity)) ** ticks
    new_mean = (heat - rules.air_capacity * gap) / (rules.air_capacity + total)
    compartment.air = new_mean + gap
    kept = (1.0 - alpha) ** ticks
    for item in items:
        item.temp = new_mean + (item.temp - mean) * kept


def _spread_odour(items: list[Item], ticks: int, rules: Rules) -> None:
    strongest = max(item.odour for item in items)
    if strongest <= 0.0:
        return
    kept = (1.0 - min(0.5, rules.odour_rate / rules.ticks_per_second)) ** ticks
    for item in items:
        item.odour = min(1.0, strongest - (strongest - item.odour) * kept)
