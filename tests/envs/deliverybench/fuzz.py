"""Random and adversarial action texts: half sensible, half hostile, all of them strings."""

from __future__ import annotations

import random

from agentspec.envs.deliverybench.city.citymap import City
from agentspec.envs.deliverybench.world.engine import HANDLERS
from agentspec.envs.deliverybench.world.state import State

HOSTILE = [
    "", " ", "()", "NAN", "nan", "inf", "-inf", "1e308", "1e999", "-1e999", "1e999m", "9" * 400, "0x10", "1_0", "0",
    "-1", "1.5", "None", "True", "[]", "[[]]", "{}", "()", "(1,)", '""', "''", '"\\x00"', "\x00", "\ud800", "“1”",
    "１２",
    "lambda: 0", "__import__('os')", "1+1", "*[1]", "**{}", "f(1)", "x=", "=", ",", ",,", "1m", "1 m", "1mm", "m",
    "1e3m",
    "[1e999]", "[None]", "[{}]", '{"item_id": []}', '[{"item_id": "ice_pack", "qty": 1e999}]', "{[]: 1}", "{1: 2}",
    '"A"', '"walk"', '"charge_done"', "b'x'", "1j", "...", "(" * 60 + ")" * 60, "[" * 90 + "]" * 90, "-" * 80 + "1",
    '"order 1: 1 -> A; 1 -> B"', '"A.1 -> B"', '"order 99999999999999999999: 1 -> A"', '"1.5 -> A"', '"1 -> "', '"->"',
    '"order 0: 1 & 2 -> A"', '"A.99999999999999999999999 -> B"', '"order ²: ² -> A"', '"order 0: ٣ -> A"', "'" * 3,
    "#", "\\",
]  # fmt: skip
KEYS = [
    "x", "y", "pace", "ids", "order_id", "id", "orders", "oid", "method", "to", "target_pct", "seconds", "until", "qty",
    "item", "item_id", "items", "name", "bag_cmd", "cmd", "comp", "bus_id", "target_stop_id", "angle", "direction",
    "text",
    "kind", "self", "class",
]  # fmt: skip
WRAPS = [
    "{}",
    " {} ",
    "```\n{}\n```",
    '{{"action": "{}"}}',
    '{{"action": {{"action_call": "{}"}}}}',
    "{};;",
    "{}\nmore",
    "say {}",
    "{{{}}}",
]


def hostile_text(rng: random.Random) -> str:
    """A call of a known or unknown name with any arguments, perhaps damaged."""
    name = rng.choice([*HANDLERS, "FLY", "", "move", "Pick Up", "MOVE_TO", "BAG"])
    parts = []
    for _ in range(rng.randint(0, 4)):
        value = (
            rng.choice(HOSTILE) if rng.random() < 0.7 else repr(rng.choice([rng.randint(-5, 30), rng.random() * 1e4]))
        )
        parts.append(f"{rng.choice(KEYS)}={value}" if rng.random() < 0.5 else value)
    text = f"{name}({', '.join(parts)})"
    if rng.random() < 0.15:
        cut = rng.randrange(len(text) + 1)
        text = text[:cut] + rng.choice(HOSTILE) + text[cut:]
    if rng.random() < 0.1:
        text = "".join(rng.choice(text + "()'\",:->m\n") for _ in range(rng.randint(0, 80)))
    return rng.choice(WRAPS).format(text) if rng.random() < 0.3 else text


def sensible_text(rng: random.Random, city: City, state: State) -> str:
    """An action a clumsy courier could choose: moves between places, deals with real orders, drives, rests, waits."""
    orders = list(state.orders) or [0]
    picked = state.carrying or orders
    order = state.orders.get(rng.choice(orders))
    spots = [poi.anchor for poi in city.pois if poi.kind not in ("building",)]
    if order is not None:
        spots += [
            order.offer.pickup.anchor,
            order.offer.dropoff.anchor,
            order.offer.handoff or order.offer.dropoff.anchor,
        ] * 4
    spots += [p for p in (state.scooter.park, state.car.park if state.car else None) if p]
    x, y = rng.choice(spots)
    pace = rng.choice(["", "", ', pace="accel"', ', pace="decel"'])
    comp, number = rng.choice("ABCDE"), rng.choice(orders)
    stop = rng.choice(city.bus.stop_names) if city.bus.stop_names else "bus_station 1"
    texts = [
        f"MOVE({x / 100:.2f}m, {y / 100:.2f}m{pace})",
        f"ACCEPT_ORDER({rng.sample(state.pool, 2)})",
        f"PICKUP(orders={orders})",
        "PICKUP()",
        f'PLACE_FOOD_IN_BAG(bag_cmd="order {number}: 1 -> {comp}; 2,3 -> {rng.choice("ABCD")}; {comp}.1 -> B")',
        f'PLACE_FOOD_IN_BAG(bag_cmd="1 & 2 -> {comp}")',
        f'DROP_OFF({rng.choice(picked)}, "{rng.choice(["knock", "call", "leave_at_door", "hand_to_customer"])}")',
        f"WAIT({rng.choice([1, 30, 120, 400])})",
        'WAIT("charge_done")' if state.charging else "VIEW_BAG()",
        f"CHARGE({rng.choice([20, 60, 100])})",
        f"REST({rng.choice([50, 100, 120])})",
        f'BUY("{rng.choice(["energy_drink", "ice_pack", "heat_pack", "escooter_battery_pack"])}", {rng.randint(1, 2)})',
        "USE_ENERGY_DRINK()", "USE_BATTERY_PACK()", f'USE_ICE_PACK("{comp}")', f'USE_HEAT_PACK("{comp}")',
        f'SWITCH("{rng.choice(["walk", "e-scooter", "car", "drag", "boat"])}")',
        "RENT_CAR()", "RETURN_CAR()", f'BOARD_BUS(bus_id="bus_1", target_stop_id="{stop}")', "VIEW_BUS_SCHEDULE()",
        f'TURN_AROUND({rng.randint(0, 360)}, "right")', "STEP_FORWARD()", "VIEW_ORDERS()",
    ]  # fmt: skip
    return rng.choice(texts + texts[:1] * 5 + texts[6:7] * 3)
