"""The world: one courier, one shift, one action after another.

`World.step` takes the text of an action and returns an `Outcome`; no text makes it raise. Simulated time jumps from
event to event (see `clock`), so a step costs the same whether it takes a second or half an hour. `snapshot` and
`restore` are exact, so a search can try actions and go back.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from agentspec.envs.deliverybench.world import help, moving, services, vehicles, work
from agentspec.envs.deliverybench.world.clock import ShiftOver, end_episode, pass_time
from agentspec.envs.deliverybench.world.grammar import Refused, understood
from agentspec.envs.deliverybench.world.recorder import evaluate, report
from agentspec.envs.deliverybench.world.settlement import Settlement
from agentspec.envs.deliverybench.world.shift import Shift
from agentspec.envs.deliverybench.world.snapshot import dump, load
from agentspec.types import Action, ActionError

_ONE_LINE_FENCE = re.compile(r"```[^\n]*```")

RETRIES = 5

Handler = Callable[[Shift, Action], str]

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
    "SAY": help.say,
    "VIEW_HELP_BOARD": help.view_help_board,
    "POST_HELP": help.post_help,
    "ACCEPT_HELP": help.no_helper,
    "EDIT_HELP": help.edit_help,
    "PLACE_TEMP_BOX": help.no_helper,
    "TAKE_FROM_TEMP_BOX": help.no_helper,
    "REPORT_HELP_FINISHED": help.no_helper,
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


class World(Shift):
    """One episode of the delivery world: a `Shift` (see there for the arguments) that takes actions as texts."""

    # -- one step ----------------------------------------------------------------------------------------------

    def step(self, text: str | Action, thought: float = 0.0) -> Outcome:
        """Carry out one action, given as text (or already parsed). Never raises, whatever the text.

        ``thought`` seconds of deliberation pass first. After the end of the episode nothing happens any more (code
        ENDED).
        """
        state = self.state
        action = text if isinstance(text, Action) else self._read(text)
        start, delivered = state.tick, len(state.settlements)
        if state.ended:
            return self._outcome(False, "ENDED", "the shift is over", start, delivered, action)
        if not self._think(thought):
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
            end_episode(self, "calls")
            outcome = self._outcome(outcome.ok, outcome.code, outcome.message, start, delivered, action)
        return outcome

    def pause(self, message: str, thought: float = 0.0) -> Outcome:
        """A call that does nothing in the world (to turn a page of the menu, say): it counts, and thinking passes."""
        state = self.state
        start, delivered, action = state.tick, len(state.settlements), Action("", text=message)
        if state.ended:
            return self._outcome(False, "ENDED", "the shift is over", start, delivered, action)
        over = not self._think(thought)
        if not over and self.max_calls is not None and state.calls >= self.max_calls:
            end_episode(self, "calls")
        return self._outcome(None if over else True, "", message, start, delivered, action)

    def _read(self, text: str) -> Action | ActionError:
        if self.rules.strict_reading and _ONE_LINE_FENCE.fullmatch(text.strip()):
            return ActionError("PARSE_NOT_CALL", "a code fence needs lines of its own; write the call alone", "")
        return understood(text, self.schema)

    def _think(self, seconds: float) -> bool:
        """Count a call and let the seconds of deliberation pass; whether the shift goes on."""
        self.state.calls += 1
        if seconds > 0.0:
            try:
                pass_time(self, self.state.tick + math.ceil(seconds * self.rules.ticks_per_second - 1e-6))
            except ShiftOver:
                return False
        return True

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

    def summary(self, hours_paid: float | None = None) -> dict[str, Any]:
        """Run report and evaluation figures so far (JSON values), with city, rule set and seed they belong to.

        Figures per hour divide by the shift, or by ``hours_paid`` if the episode was cut before its end.
        """
        result = report(self.look(), self.recorder, self.shift_hours, self.rules.initial_balance, hours_paid)
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
