"""Every number of the delivery world, and one named switch per quirk of the original logic.

`Rules` is the whole rule book: speeds, energy, prices, tolerances, food physics, order generation, settlement. Two
rule sets ship. ``"original"`` keeps every quirk, so that results compare with published DeliveryBench runs and replays
are exact. ``"fair"`` (the default of the world) closes what no courier could do: carrying food in a state of suspended
animation, riding a scooter that is parked elsewhere, resting above 100 %, walking the last metres in no time, and so
on. A policy trained under "original" may learn these loopholes instead of the task; under "fair" it cannot.

A switch is True where the quirk is *present*. `quirk_table` renders the list for the documentation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

MODES = ("walk", "e-scooter", "drag_scooter", "car", "bus")


SPEED = {"walk": 200.0, "e-scooter": 600.0, "drag_scooter": 150.0, "car": 1200.0, "bus": 1000.0}
ENERGY_PER_M = {"walk": 0.08, "e-scooter": 0.01, "drag_scooter": 0.1, "car": 0.008, "bus": 0.006}
PACE = {"accel": 1.25, "normal": 1.0, "decel": 0.75}
PRICES = {"energy_drink": 6.0, "escooter_battery_pack": 10.0, "ice_pack": 3.0, "heat_pack": 3.0}


def quirk(text: str) -> Any:
    """A switch that is on in the original logic; ``text`` says what it means (one line, for the docs)."""
    return field(default=True, metadata={"quirk": text})


@dataclass(frozen=True)
class Rules:
    """The rule book. Lengths in cm, speeds in cm/s, times in s, energy and battery in % of 100, money in dollars.

    Build one with `rules_named` ("original", "fair") and change single entries with `dataclasses.replace`.
    """

    name: str = "original"

    # Clock and episode
    ticks_per_second: int = 10
    max_calls: int | None = 200
    initial_balance: float = 100.0
    spawn: tuple[float, float] = (-1.2, 0.8)

    # Movement
    speed: Mapping[str, float] = field(default_factory=lambda: dict(SPEED))
    energy_per_m: Mapping[str, float] = field(default_factory=lambda: dict(ENERGY_PER_M))
    pace: Mapping[str, float] = field(default_factory=lambda: dict(PACE))
    nearby: float = 500.0
    pickup_tolerance: float = 600.0
    bus_tolerance: float = 1000.0
    stop_radius: float = 136.6
    step_length: float = 100.0
    look_seconds: float = 10.0

    # Scooter, charging, rest, hospital
    initial_battery: float = 50.0
    battery_per_m: float = 0.04
    charge_per_min: float = 7.5
    charge_price: float = 0.05
    rest_per_min: float = 7.5
    energy_max: float = 100.0
    hospital_seconds: float = 900.0
    hospital_fee: float = 5.0

    # Shop, car, bus
    prices: Mapping[str, float] = field(default_factory=lambda: dict(PRICES))
    drink_gain: float = 50.0
    pack_battery: float = 100.0
    rental_per_min: float = 1.0
    bus_fare: float = 1.0
    bus_dwell: float = 360.0

    # Food and bag
    ambient: float = 22.0
    first_air: float = 23.0
    food_rate: float = 1.0 / 1800.0
    bag_rate: float = 1.0 / 600.0
    air_capacity: float = 0.4
    odour_rate: float = 1.0 / 900.0
    ice_pack: tuple[float, float] = (0.0, 8.0)
    heat_pack: tuple[float, float] = (60.0, 5.0)

    # Orders
    pool_size: int = 10
    max_active_orders: int | None = None
    note_probability: float = 0.4
    pay_per_km: float = 10.0
    eta_speed: float = 1.6
    eta_slack: float = 1.25

    # Settlement
    grace: float = 60.0
    late_floor: float = 0.5
    time_cutoffs: tuple[float, ...] = (1.0, 1.1, 1.25, 1.5)
    temp_cutoffs: tuple[float, ...] = (4.0, 7.0, 10.0, 15.0)
    odour_cutoffs: tuple[float, ...] = (0.05, 0.15, 0.30, 0.50)
    damage_stars: tuple[int, ...] = (5, 3, 2, 1)
    item_weights: tuple[float, float, float] = (0.5, 0.2, 0.3)
    temp_ok: float = 7.0
    odour_ok: float = 0.30
    damage_fail: int = 2
    bonus: tuple[float, ...] = (-2.0, -2.0, 0.0, 0.0, 1.5, 3.0)

    # Quirks of the original logic (True = present)
    hand_food_is_inert: bool = quirk("Food in the hand keeps its temperature and is never damaged: never bag anything.")
    ride_with_food_in_hand: bool = quirk("MOVE and STEP_FORWARD on a vehicle work with unbagged food in the hand.")
    placing_freezes_food: bool = quirk("Each bag command freezes the graded state of all food bagged before it.")
    ride_parked_scooter: bool = quirk("A refused SWITCH parks the vehicle but the courier goes on riding it.")
    rest_above_full: bool = quirk("REST accepts targets above 100 % energy.")
    return_absent_car: bool = quirk("RETURN_CAR does not need the car to be at the rental.")
    charging_ends_waits: bool = quirk("Finished or interrupted charging also ends a plain timed WAIT.")
    hanging_wait: bool = quirk('WAIT("charge_done") without a charging session waits until the shift ends.')
    bus_ride_costs_walking: bool = quirk("A bus ride is charged as if travelled in the mode before boarding.")
    bus_carries_vehicle: bool = quirk("A ridden scooter or car travels along on the bus.")
    hospital_carries_vehicle: bool = quirk("The hospital takes the ridden vehicle along and drains the scooter for it.")
    ghost_car: bool = quirk("A car taken back for unpaid rent can still be driven, free of charge, until SWITCH.")
    bare_pickup_fails: bool = quirk("PICKUP() without a list never works, although one order may be ready here.")
    zero_id_fails: bool = quirk("ACCEPT_ORDER(order_id=0) is unreadable because 0 counts as missing.")
    bare_numbers_are_cm: bool = quirk("Coordinates without the unit m are centimetres.")
    strict_reading: bool = quirk("A code fence that stands on one line with what it holds is unreadable.")
    handoff_hidden: bool = quirk("The point where a customer takes the food by hand is never told.")
    odd_bus_line: bool = quirk("The bus serves the terminal twice and uses wrong leg lengths on the way back.")
    stale_error: bool = quirk("A move that fails silently leaves the previous error text standing.")
    drag_keeps_charging: bool = quirk("Dragging the scooter away keeps its charging session open until the next tick.")
    vanishing_food: bool = quirk("Numbers outside a well-formed clause make food vanish or appear twice in the bag.")
    equal_food_vanishes: bool = quirk("Delivering an order removes equal food of other orders from the bag as well.")
    free_last_metres: bool = quirk("The last 3.6 m of a move and STEP_FORWARD take no time.")
    views_after_parse_errors: bool = quirk("The sixth unreadable answer in a row is taken as VIEW_ORDERS.")
    free_looks: bool = quirk("Looking again at what is shown already (VIEW_ORDERS, VIEW_BAG, ...) takes no time.")
    methods_hidden: bool = quirk("The hand-over methods a note allows are not told at the customer's, only the note.")
    last_call_is_cut: bool = quirk("The action of the last allowed call is cut off at its first tick.")

    def with_config(self, config: Mapping[str, Any]) -> Rules:
        """These rules with the numbers of a `game_mechanics` mapping (the key names of the original's settings).

        Unknown keys are ignored; a number of the wrong type raises ValueError naming the key.
        """
        changes: dict[str, Any] = {}
        for path, name in _CONFIG_KEYS.items():
            value: Any = config
            for part in path.split("."):
                value = value.get(part) if isinstance(value, Mapping) else None
            if value is None:
                continue
            if isinstance(value, Mapping):
                changes[name] = {**getattr(self, name), **{k: float(v) for k, v in value.items()}}
            elif isinstance(value, (int, float)):
                changes[name] = value if name == "max_calls" else float(value)
            else:
                raise ValueError(f"setting {path!r} is {value!r}; expected a number or a table of numbers")
        return replace(self, **changes)


_CONFIG_KEYS = {
    "avg_speed_cm_s": "speed",
    "pace_scales": "pace",
    "energy_pct_decay_per_m_by_mode": "energy_per_m",
    "bus.waiting_time_s": "bus_dwell",
    "scooter_batt_decay_pct_per_m": "battery_per_m",
    "energy_pct_max": "energy_max",
    "rest_rate_pct_per_min": "rest_per_min",
    "hospital_duration_s": "hospital_seconds",
    "hospital_rescue_fee": "hospital_fee",
    "ambient_temp_c": "ambient",
    "initial_earnings": "initial_balance",
    "charge_price_per_percent": "charge_price",
    "escooter_defaults.initial_battery_pct": "initial_battery",
    "escooter_defaults.charge_rate_pct_per_min": "charge_per_min",
    "rent_car_defaults.rate_per_min": "rental_per_min",
    "items.energy_drink.energy_gain_pct": "drink_gain",
    "items.escooter_battery_pack.target_charge_pct": "pack_battery",
    "tolerance_cm.nearby": "nearby",
    "lifecycle.vlm_call_limit": "max_calls",
}


def quirks() -> dict[str, str]:
    """Name of each quirk switch -> its one-line meaning, in the order of the rule book."""
    return {f.name: f.metadata["quirk"] for f in fields(Rules) if "quirk" in f.metadata}


ORIGINAL = Rules()
_QUIRKS_OFF: dict[str, Any] = dict.fromkeys(quirks(), False)
FAIR = replace(ORIGINAL, name="fair", max_calls=None, max_active_orders=10, **_QUIRKS_OFF)
RULE_SETS: Mapping[str, Rules] = {"original": ORIGINAL, "fair": FAIR}


def rules_named(rules: Rules | str) -> Rules:
    """The rule set of that name, or ``rules`` itself if it already is one.

    Raises:
        ValueError: an unknown name.
    """
    if isinstance(rules, Rules):
        return rules
    if rules not in RULE_SETS:
        raise ValueError(f"unknown rule set {rules!r}; expected one of {', '.join(RULE_SETS)} or a Rules object")
    return RULE_SETS[rules]


def quirk_table() -> str:
    """Markdown table of all quirk switches and their setting in each rule set (for the documentation)."""
    lines = ["| switch | meaning when on | " + " | ".join(RULE_SETS) + " |"]
    lines.append("|---|---|" + "---|" * len(RULE_SETS))
    for name, text in quirks().items():
        states = " | ".join("on" if getattr(rules, name) else "off" for rules in RULE_SETS.values())
        lines.append(f"| `{name}` | {text} | {states} |")
    return "\n".join(lines)
