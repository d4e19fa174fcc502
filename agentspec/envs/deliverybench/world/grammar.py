"""The action language of the delivery world: its schema, and readers that turn arguments into checked values.

Actions are calls with literal arguments (see `agentspec.actions`); lengths may carry the unit ``m``. The schema lists
every action with its parameters and an example; `schema_for` fits it to a rule set. Handlers read their arguments with
`number`, `whole` and `ids`, which raise `Refused` with a message that says what was given and what to write.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

from agentspec.actions import parse_action
from agentspec.envs.deliverybench.world.notes import METHODS
from agentspec.envs.deliverybench.world.rules import Rules
from agentspec.types import Action, ActionError, ActionSchema, ActionSpec, Parameter

MAX_COORDINATE = 1e7
"""Farthest coordinate (cm) a move may name: 100 km, far outside any city."""

MAX_INTEGER = 10**12
MAX_TEXT = 4000
_MISSING = object()


class Refused(Exception):  # noqa: N818 - an outcome, not an error
    """An action that fails: an own ``code``, a ``message`` for the agent; nothing else of the action happens.

    ``unread`` marks answers whose arguments make no sense (they count as parse errors, not as attempts), ``silent``
    failures about which the original tells the agent nothing.
    """

    def __init__(self, code: str, message: str, *, unread: bool = False, silent: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.unread = unread
        self.silent = silent


def _spec(name: str, description: str, example: str, /, **parameters: Parameter) -> ActionSpec:
    return ActionSpec(name, description, parameters, example)


_ANY, _NUM, _STR, _LIST = (Parameter(kind, required=False) for kind in ("any", "float", "str", "list"))
_COMP = Parameter("str", enum=("A", "B", "C", "D"))

_SPECS: tuple[ActionSpec, ...] = (
    _spec("VIEW_ORDERS", "show the orders on offer", "VIEW_ORDERS()"),
    _spec("ACCEPT_ORDER", "accept one or several orders by id", "ACCEPT_ORDER([3, 7])", ids=Parameter("any")),
    _spec(
        "MOVE",
        "travel to a point in the current mode; pace is normal, accel or decel",
        'MOVE(120.5m, -48m, pace="normal")',
        x=Parameter("float"),
        y=Parameter("float"),
        pace=Parameter("str", required=False, enum=("accel", "normal", "decel")),
    ),
    _spec("PICKUP", "take the ready food of your orders at this restaurant", "PICKUP(orders=[3])", orders=_LIST),
    _spec(
        "PLACE_FOOD_IN_BAG",
        "put food from your hands into the bag, whose compartments are A, B, C and D: numbers are the items of the "
        "order in your hands; A.1 -> B moves the first item of A",
        'PLACE_FOOD_IN_BAG(bag_cmd="order 3: 1,2 -> A; 3 -> B")',
        bag_cmd=Parameter("str"),
    ),
    _spec("VIEW_BAG", "look at temperatures and contents of the bag", "VIEW_BAG()"),
    _spec(
        "DROP_OFF",
        f"deliver an order at its drop-off; method is {', '.join(METHODS[:-1])} or {METHODS[-1]}",
        'DROP_OFF(oid=3, method="leave_at_door")',
        oid=Parameter("int"),
        method=Parameter("str", enum=METHODS),
    ),
    _spec(
        "CHARGE", "charge the scooter at a charging station here, to 1-100 %", "CHARGE(target_pct=80)", target_pct=_NUM
    ),
    _spec(
        "WAIT",
        "wait some seconds, or until charging is done",
        'WAIT(60) or WAIT("charge_done")',
        seconds=_ANY,
        until=_STR,
        duration_s=_NUM,
    ),
    _spec("REST", "rest at a rest area here until that energy, 1-100 %", "REST(target_pct=100)", target_pct=_NUM),
    _spec(
        "BUY",
        "buy at a store here: energy_drink, escooter_battery_pack, ice_pack or heat_pack",
        'BUY(item_id="energy_drink", qty=1)',
        item_id=_STR,
        qty=_NUM,
        items=_LIST,
        item=_STR,
        name=_STR,
    ),
    _spec("USE_ENERGY_DRINK", "drink one: +50 % energy", "USE_ENERGY_DRINK()"),
    _spec("USE_BATTERY_PACK", "fill the scooter's battery, in hand or parked here", "USE_BATTERY_PACK()"),
    _spec("USE_ICE_PACK", "put an ice pack into bag compartment A, B, C or D", 'USE_ICE_PACK(comp="A")', comp=_COMP),
    _spec("USE_HEAT_PACK", "put a heat pack into bag compartment A, B, C or D", 'USE_HEAT_PACK(comp="A")', comp=_COMP),
    _spec(
        "SWITCH",
        "change the way of travelling: walk, e-scooter, car or drag_scooter; what you leave stays parked here",
        'SWITCH(to="walk")',
        to=Parameter("str", enum=("walk", "e-scooter", "car", "drag_scooter")),
    ),
    _spec("RENT_CAR", "rent a car at a car rental here, billed by the minute", "RENT_CAR()"),
    _spec("RETURN_CAR", "give the rented car back at a car rental", "RETURN_CAR()"),
    _spec(
        "BOARD_BUS",
        "board the bus standing here and ride to a stop of its line",
        'BOARD_BUS(bus_id="bus_1", target_stop_id="bus_station 2")',
        bus_id=Parameter("str"),
        target_stop_id=Parameter("str"),
    ),
    _spec("VIEW_BUS_SCHEDULE", "show where the bus is and its stops", "VIEW_BUS_SCHEDULE()"),
    _spec(
        "TURN_AROUND",
        "turn by an angle in degrees, left or right",
        'TURN_AROUND(angle=90, direction="right")',
        angle=Parameter("float"),
        direction=Parameter("str", required=False, enum=("left", "right")),
    ),
    _spec("STEP_FORWARD", "go one metre straight ahead", "STEP_FORWARD()"),
    _spec("SAY", "say something to everybody or to one courier", 'SAY(text="hello")', text=_STR, to=_STR),
    _spec("VIEW_HELP_BOARD", "show requests for help", "VIEW_HELP_BOARD()"),
    _spec(
        "POST_HELP", "ask other couriers for help", 'POST_HELP(kind="HELP_DELIVERY", order_id=3, bounty=3)', kind=_STR
    ),
    _spec("ACCEPT_HELP", "accept a request for help", "ACCEPT_HELP(req_id=1)", req_id=_ANY),
    _spec(
        "EDIT_HELP",
        "change an own request",
        "EDIT_HELP(req_id=1, new_bounty=5)",
        req_id=_ANY,
        new_bounty=_NUM,
        new_ttl=_NUM,
    ),
    _spec("PLACE_TEMP_BOX", "put things for another courier into a box", "PLACE_TEMP_BOX(req_id=1)", req_id=_ANY),
    _spec("TAKE_FROM_TEMP_BOX", "take what another courier left", "TAKE_FROM_TEMP_BOX(req_id=1)", req_id=_ANY),
    _spec("REPORT_HELP_FINISHED", "report a request as done", "REPORT_HELP_FINISHED(req_id=1)", req_id=_ANY),
)

ALIASES: Mapping[str, str] = {
    "MOVE_TO": "MOVE",
    "PLACE_IN_BAG": "PLACE_FOOD_IN_BAG",
    "PLACE_BAG": "PLACE_FOOD_IN_BAG",
    "BAG": "PLACE_FOOD_IN_BAG",
    "CHARGE_ESCOOTER": "CHARGE",
    "SWITCH_TRANSPORT": "SWITCH",
    "DELIVER": "DROP_OFF",
}


DEFAULTS: Mapping[tuple[str, str], Any] = {
    ("MOVE", "pace"): "normal",
    ("BUY", "qty"): 1,
    ("TURN_AROUND", "direction"): "left",
}
"""What leaving out an argument means."""

_LENGTHS = frozenset({("MOVE", "x"), ("MOVE", "y")})


def schema_for(rules: Rules) -> ActionSchema:
    """The action schema of a rule set. Lengths arrive in cm (``12m`` is 1200.0 and 12 is 12 cm) under the quirk
    ``bare_numbers_are_cm``, otherwise in metres (``12m`` and 12 are both 12)."""
    return _schema(rules.bare_numbers_are_cm)


_METRES = ("m", "meter", "meters", "metre", "metres")
_SECONDS = dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0) | dict.fromkeys(
    ("min", "mins", "minute", "minutes"), 60.0
)


@lru_cache(maxsize=2)
def _schema(centimetres: bool = False) -> ActionSchema:
    metre = 100.0 if centimetres else 1.0
    return ActionSchema(
        {spec.name: _fitted(spec, metre) for spec in _SPECS}, ALIASES, _SECONDS | dict.fromkeys(_METRES, metre)
    )


def _fitted(spec: ActionSpec, metre: float) -> ActionSpec:
    """The action with what its omitted arguments mean, and the differences that matter to the world."""
    parameters = {
        name: replace(
            parameter,
            default=DEFAULTS.get((spec.name, name)),
            resolution=metre if (spec.name, name) in _LENGTHS else 1.0 if parameter.type == "float" else 0.0,
        )
        for name, parameter in spec.parameters.items()
    }
    return replace(spec, parameters=parameters)


SOCIAL = (
    "SAY",
    "VIEW_HELP_BOARD",
    "POST_HELP",
    "ACCEPT_HELP",
    "EDIT_HELP",
    "PLACE_TEMP_BOX",
    "TAKE_FROM_TEMP_BOX",
    "REPORT_HELP_FINISHED",
)
"""Actions that are addressed to other couriers."""


def advertised(schema: ActionSchema) -> ActionSchema:
    """The schema without the actions that are of no use to the only courier of a city; they still work when called."""
    specs = {name: spec for name, spec in schema.actions.items() if name not in SOCIAL}
    return replace(schema, actions=specs)


def understood(text: str, schema: ActionSchema) -> Action | ActionError:
    """The action of a text; one of more than `MAX_TEXT` characters is none, and is not searched for any."""
    if len(text) > MAX_TEXT:
        problem = f"the answer has {len(text)} characters; write one action only"
        return ActionError("PARSE_TOO_LONG", problem, text[:200])
    return parse_action(text, schema)


def argument(action: Action, position: int, *names: str) -> Any:
    """The argument of that name (first of ``names`` given) or position, None when absent."""
    for name in names:
        value = action.kwargs.get(name, _MISSING)
        if value is not _MISSING:
            return value
    return action.args[position] if 0 <= position < len(action.args) else None


def number(value: Any, action: Action, name: str, default: float | None = None) -> float:
    """A finite number; numeric strings are read, None gives ``default``.

    Raises:
        Refused: PARSE_ARGS when it is missing, no number, or not finite.
    """
    if value is None and default is not None:
        return default
    try:
        result = float(value.strip().removesuffix("m") if isinstance(value, str) else value)
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    if not math.isfinite(result) or abs(result) > MAX_INTEGER:
        raise unread(action, f"{name} must be a number, not {short(value)}")
    return result


def whole(value: Any, action: Action, name: str) -> int:
    """An integer: an int, an integral-looking string, or a float cut to its integer part; else Refused PARSE_ARGS."""
    try:
        result = int(value)
    except (TypeError, ValueError, OverflowError):
        raise unread(action, f"{name} must be a whole number, not {short(value)}") from None
    if abs(result) > MAX_INTEGER:
        raise unread(action, f"{name} is out of range")
    return result


def ids(value: Any, action: Action, name: str) -> list[int]:
    """One or several order ids, without repetitions, in the order given; else Refused PARSE_ARGS."""
    values = value if isinstance(value, (list, tuple)) else [value]
    return list(dict.fromkeys(whole(item, action, name) for item in values))


def unread(action: Action, problem: str, code: str = "PARSE_ARGS") -> Refused:
    """The refusal of an action whose arguments cannot be used, with an example of the right form."""
    spec = _schema().actions.get(action.name)
    example = f"; write {spec.example}" if spec else ""
    return Refused(code, f"{action.name}: {problem}{example}", unread=True)


def short(value: Any) -> str:
    """A value for a message, cut to a readable length."""
    shown = repr(value)
    return shown if len(shown) <= 40 else shown[:37] + "..."
