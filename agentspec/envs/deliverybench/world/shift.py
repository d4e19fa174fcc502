"""The shift: the state of one episode, and the small changes that all actions are made of.

`Shift` knows the city, the rules, the orders and the timetable, and holds the `State`. Passing time (`clock`) and the
actions (`moving`, `work`, `vehicles`, `services`) are functions that take it; `engine.World` puts them behind texts.
Every change of the balance goes through `pay`, which keeps the ledger.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from agentspec.envs.deliverybench.city.citymap import City
from agentspec.envs.deliverybench.world.bag import MAX_DAMAGE, Bag
from agentspec.envs.deliverybench.world.food import toward_ambient
from agentspec.envs.deliverybench.world.grammar import schema_for
from agentspec.envs.deliverybench.world.recorder import Recorder
from agentspec.envs.deliverybench.world.rules import Rules, rules_named
from agentspec.envs.deliverybench.world.shared import shared
from agentspec.envs.deliverybench.world.state import DEPLETED, PARKED, USABLE, Notice, Point, Scooter, State
from agentspec.types import ActionSchema

RECENT = 5


class Shift:
    """One shift in ``city``: its state, and what the actions do to it.

    Args:
        city: the compiled city (shared, never changed).
        rules: "fair", "original" or a `Rules` object.
        seed: selects the sequence of orders; None is the one sequence of the original runner.
        shift_hours: length of the shift in simulated hours.
        max_calls: actions allowed, readable or not; None takes the number of the rules.

    Raises:
        ValueError: unknown rules, a shift or call limit that is not positive, or a city without orders.
    """

    def __init__(
        self,
        city: City,
        rules: Rules | str = "fair",
        seed: int | None = 0,
        shift_hours: float = 1.0,
        max_calls: int | None = None,
    ) -> None:
        if not (math.isfinite(shift_hours) and 0.0 < shift_hours <= 1000.0):
            raise ValueError(f"shift_hours is {shift_hours!r}; expected a positive number of hours up to 1000")
        self.city = city
        self.rules = rules_named(rules)
        self.seed = seed
        self.shift_hours = shift_hours
        self.max_calls = self.rules.max_calls if max_calls is None else max_calls
        if self.max_calls is not None and self.max_calls < 1:
            raise ValueError(f"max_calls is {self.max_calls}; expected at least 1, or None for the rules' own limit")
        self.schema: ActionSchema = schema_for(self.rules)
        self.shift_ticks = max(1, math.ceil(shift_hours * 3600.0 * self.rules.ticks_per_second - 1e-6))
        self.last_tick = self.shift_ticks
        self.book, self.timetable = shared(city, self.rules, seed)
        self.recorder = Recorder()
        self._identity = [city.name, self.rules.name, seed, self.shift_ticks]
        self._inert = self.rules.hand_food_is_inert
        self.state = self._fresh()

    def _fresh(self) -> State:
        rules = self.rules
        state = State(
            position=rules.spawn,
            energy=rules.energy_max,
            balance=rules.initial_balance,
            scooter=Scooter(rules.initial_battery),
            bag=Bag(rules),
            pool=list(range(rules.pool_size)),
            next_order=rules.pool_size,
        )
        return state

    # -- looking at it -----------------------------------------------------------------------------------------

    def look(self) -> State:
        """The state with food temperatures brought up to date."""
        self.state.bag.advance(self.state.tick)
        if not self._inert:
            self._air_hands()
        return self.state

    @property
    def seconds(self) -> float:
        """Simulated time since the shift began."""
        return self.state.tick / self.rules.ticks_per_second

    # -- what handlers use -------------------------------------------------------------------------------------

    def pay(self, kind: str, amount: float) -> None:
        """Book ``amount`` dollars (negative for an expense) under a ledger kind."""
        self.state.ledger[kind] += amount
        self.state.balance += amount

    def remember(self, summary: str) -> None:
        """A success: it enters the list of recent actions and clears the last error."""
        recent = self.state.recent
        recent.append(summary)
        del recent[:-RECENT]
        self.state.error = ""

    def notify(self, kind: str, text: str, data: Mapping[str, Any] | None = None) -> None:
        """Show a notice of this kind, in place of an older one; `data` are the facts behind the text."""
        notices = self.state.notices
        notices[:] = [notice for notice in notices if notice.kind != kind]
        notices.append(Notice(kind, text, data or {}))

    def near(self, point: Point | None) -> bool:
        """Whether a point is within reach; None (in use) is."""
        return point is None or math.dist(point, self.state.position) <= self.rules.nearby

    def set_mode(self, mode: str) -> None:
        """Change the way of travelling; the pace returns to normal."""
        self.state.mode = mode
        self.state.pace = "normal"

    def step_length(self) -> float:
        """Centimetres per tick in the current mode and pace."""
        rules, state = self.rules, self.state
        return rules.speed[state.mode] * rules.pace[state.pace] / rules.ticks_per_second

    def route(self, target: Point) -> tuple[Point, ...]:
        """The way from here to ``target`` in the current mode (cm)."""
        route = self.city.car_route if self.state.mode == "car" else self.city.walk_route
        return route(self.state.position, target)

    def park_scooter(self) -> None:
        """Leave the scooter here."""
        scooter = self.state.scooter
        scooter.state, scooter.park = PARKED, self.state.position

    def unpark_scooter(self) -> None:
        """Take the scooter in hand."""
        scooter = self.state.scooter
        scooter.state = USABLE if scooter.battery > 0.0 else DEPLETED
        scooter.park = None

    def park_car(self) -> None:
        """Leave the rented car here (if it is still there)."""
        car = self.state.car
        if car is not None:
            car.state, car.park = PARKED, self.state.position

    def park_vehicle(self) -> None:
        """Leave whatever is ridden, dragged or driven here and go on foot."""
        if self.state.mode in ("e-scooter", "drag_scooter"):
            self.park_scooter()
        elif self.state.mode == "car":
            self.park_car()
        self.set_mode("walk")

    def drain_battery(self, metres: float, slack: float = 0.0) -> bool:
        """Use the scooter's battery for ``metres`` (times the pace factor); whether it is empty now."""
        scooter = self.state.scooter
        used = metres * self.rules.battery_per_m
        empty = scooter.battery - used <= slack
        if empty:
            used = scooter.battery
        scooter.battery -= used
        self.recorder.battery_used += used
        return empty

    def deplete(self) -> None:
        """The ridden scooter's battery is empty: from now on it is dragged."""
        scooter = self.state.scooter
        if scooter.state != PARKED:
            scooter.state = DEPLETED
        self.set_mode("drag_scooter")
        self.recorder.interruptions["scooter_depleted"] += 1
        self.notify("depleted", "the scooter's battery is empty: you drag it now; charge it or use a battery pack")

    def shake_food(self) -> None:
        """A hasty move damages fragile food in the bag (and in the hand, unless that is inert)."""
        self.look()
        self.state.bag.shake()
        if not self._inert:
            for order in self.state.orders.values():
                for item in order.pending:
                    if item.food is not None and item.food.fragile:
                        item.damage = min(MAX_DAMAGE, item.damage + 1)

    def fill_pool(self) -> None:
        """Draw new orders until the pool is full again."""
        state = self.state
        while len(state.pool) < self.rules.pool_size:
            state.pool.append(state.next_order)
            state.next_order += 1

    def _air_hands(self) -> None:
        """Food in the hand moves towards ambient temperature; ``hands_at`` remembers up to when."""
        state, rules = self.state, self.rules
        seconds = (state.tick - state.hands_at) / rules.ticks_per_second
        state.hands_at = state.tick
        if seconds <= 0.0:
            return
        for order in state.orders.values():
            for item in order.pending:
                item.temp = toward_ambient(item.temp, rules.ambient, rules.food_rate, seconds)
