"""The world: one courier, one shift, one action after another.

`World.step` takes the text of an action and returns an `Outcome`; no text makes it raise. Simulated time jumps from
event to event (see `clock`), so a step costs the same whether it takes a second or half an hour. Every change of the
balance goes through `pay`, which keeps the ledger. `snapshot` and `restore` are exact, so a search can try actions and
go back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from agentspec.actions import parse_action
from agentspec.envs.deliverybench import moving, services, vehicles, work
from agentspec.envs.deliverybench.bag import MAX_DAMAGE, Bag
from agentspec.envs.deliverybench.citymap import City
from agentspec.envs.deliverybench.clock import ShiftOver, pass_time, stop_charging
from agentspec.envs.deliverybench.food import toward_ambient
from agentspec.envs.deliverybench.grammar import Refused, schema_for
from agentspec.envs.deliverybench.recorder import Recorder, evaluate, report
from agentspec.envs.deliverybench.rules import Rules, rules_named
from agentspec.envs.deliverybench.settlement import Settlement
from agentspec.envs.deliverybench.shared import shared
from agentspec.envs.deliverybench.snapshot import dump, load
from agentspec.envs.deliverybench.state import DEPLETED, PARKED, USABLE, Notice, Point, Scooter, State
from agentspec.types import Action, ActionError, ActionSchema

RECENT = 5
RETRIES = 5

Handler = Callable[["World", Action], str]

HANDLERS: dict[str, Handler] = {
    "VIEW_ORDERS": work.view_orders,
    "ACCEPT_ORDER": work.accept_order,
    "MOVE": moving.move,
    "PICKUP": work.pickup,
    "PLACE_FOOD_IN_BAG": work.place_food_in_bag,
    "VIEW_BAG": work.view_bag,
    "DROP_OFF": work.drop_off,
    "CHARGE": vehicles.charge,
    "WAIT": services.wait,
    "REST": services.rest,
    "BUY": services.buy,
    "USE_ENERGY_DRINK": services.use_energy_drink,
    "USE_BATTERY_PACK": vehicles.use_battery_pack,
    "USE_ICE_PACK": services.use_ice_pack,
    "USE_HEAT_PACK": services.use_heat_pack,
    "SWITCH": vehicles.switch,
    "RENT_CAR": vehicles.rent_car,
    "RETURN_CAR": vehicles.return_car,
    "BOARD_BUS": vehicles.board_bus,
    "VIEW_BUS_SCHEDULE": vehicles.view_bus_schedule,
    "TURN_AROUND": moving.turn_around,
    "STEP_FORWARD": moving.step_forward,
    "SAY": services.say,
    "VIEW_HELP_BOARD": services.view_help_board,
    "POST_HELP": services.post_help,
    "ACCEPT_HELP": services.no_helper,
    "EDIT_HELP": services.no_helper,
    "PLACE_TEMP_BOX": services.no_helper,
    "TAKE_FROM_TEMP_BOX": services.no_helper,
    "REPORT_HELP_FINISHED": services.no_helper,
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one step did.

    Attributes:
        ok: success; None when the episode ended during the action, which then has no result.
        code: own code of the failure, "" on success.
        message: what happened, for the agent.
        seconds: simulated time that passed.
        ended, reason: whether the episode is over, and why ("shift" or "calls").
        settlements: orders delivered in this step.
        action: the parsed action, or the parse error.
    """

    ok: bool | None
    code: str
    message: str
    seconds: float
    ended: bool
    reason: str
    settlements: tuple[Settlement, ...]
    action: Action | ActionError


class World:
    """One episode of the delivery world in ``city``.

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

    # -- one step ----------------------------------------------------------------------------------------------

    def step(self, text: str | Action, thought: float = 0.0) -> Outcome:
        """Carry out one action, given as text (or already parsed). Never raises, whatever the text.

        ``thought`` seconds of deliberation pass first. After the end of the episode nothing happens any more (code
        ENDED).
        """
        state = self.state
        action = text if isinstance(text, Action) else parse_action(text, self.schema)
        start, delivered = state.tick, len(state.settlements)
        if state.ended:
            return self._outcome(False, "ENDED", "the shift is over", start, delivered, action)
        state.calls += 1
        if thought > 0.0:
            try:
                pass_time(self, state.tick + math.ceil(thought * self.rules.ticks_per_second - 1e-6))
            except ShiftOver:
                message = "the shift ended while you were thinking"
                return self._outcome(None, "", message, start, delivered, action)
        last = self.max_calls is not None and state.calls >= self.max_calls
        if last and self.rules.last_call_is_cut:
            self.last_tick = min(self.shift_ticks, state.tick + 1)
        if isinstance(action, ActionError):
            outcome = self._unread(action, action.code, action.message, start)
        else:
            outcome = self._perform(action, start, delivered)
        if last and not state.ended:
            self.end("calls")
            outcome = self._outcome(outcome.ok, outcome.code, outcome.message, start, delivered, action)
        return outcome

    def _perform(self, action: Action, start: int, delivered: int) -> Outcome:
        state = self.state
        kind = action.name
        handler = HANDLERS.get(kind)
        if handler is None:
            return self._unread(action, "PARSE_UNKNOWN", f"there is no action {kind}", start)
        try:
            summary = handler(self, action)
        except ShiftOver:
            self.recorder.attempts[kind] += 1
            return self._outcome(None, "", "the shift ended", start, delivered, action)
        except Refused as refusal:
            if refusal.unread:
                return self._unread(action, refusal.code, refusal.message, start)
            state.parse_errors = 0
            self.recorder.attempts[kind] += 1
            if not (refusal.silent and self.rules.stale_error):
                state.error = f"tried {action.text or kind} but failed: {refusal.message}"
            return self._outcome(False, refusal.code, refusal.message, start, delivered, action)
        state.parse_errors = 0
        self.recorder.attempts[kind] += 1
        self.recorder.successes[kind] += 1
        self.remember(summary)
        return self._outcome(True, "", summary, start, delivered, action)

    def _unread(self, action: Action | ActionError, code: str, message: str, start: int) -> Outcome:
        """An answer that is no action costs a call but no time."""
        state = self.state
        self.recorder.parse_failures += 1
        state.parse_errors += 1
        state.error = message
        if state.parse_errors > RETRIES and self.rules.views_after_parse_errors:
            state.parse_errors = 0
            self.recorder.attempts["VIEW_ORDERS"] += 1
            self.recorder.successes["VIEW_ORDERS"] += 1
            self.remember(work.view_orders(self, Action("VIEW_ORDERS")))
        return self._outcome(False, code, message, start, len(state.settlements), action)

    def _outcome(
        self, ok: bool | None, code: str, message: str, start: int, delivered: int, action: Action | ActionError
    ) -> Outcome:
        state = self.state
        seconds = (state.tick - start) / self.rules.ticks_per_second
        settled = tuple(state.settlements[delivered:])
        return Outcome(ok, code, message, seconds, state.ended, state.reason, settled, action)

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

    def summary(self) -> dict[str, Any]:
        """Run report and evaluation figures so far (JSON values), with city, rule set and seed they belong to."""
        result = report(self.look(), self.recorder, self.shift_hours, self.rules.initial_balance)
        result["meta"] |= {"city": self.city.name, "rules": self.rules.name, "seed": self.seed}
        return result

    def evaluation(self) -> dict[str, float | None]:
        """The evaluation figures alone (cheap)."""
        return evaluate(self.state, self.recorder, self.shift_hours, self.rules.initial_balance)

    def snapshot(self) -> bytes:
        """The exact state as bytes, for `restore` into a world of the same city, rules and seed."""
        return dump(self.state, self.recorder, self._identity)

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`.

        Raises:
            ValueError: the bytes are no snapshot of such a world.
        """
        self.state, self.recorder = load(blob, self.rules, self.book, self._identity)
        self.last_tick = self.shift_ticks

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

    def notify(self, kind: str, text: str) -> None:
        """Show a notice of this kind, in place of an older one."""
        notices = self.state.notices
        notices[:] = [notice for notice in notices if notice.kind != kind]
        notices.append(Notice(kind, text))

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

    def end(self, reason: str) -> None:
        """End the episode: rental and charging are closed."""
        state = self.state
        state.reason = reason
        stop_charging(self, "ended")
        if state.car is not None:
            self.recorder.rentals.append((state.car.since, state.tick))

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
