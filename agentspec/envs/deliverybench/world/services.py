"""Waiting, resting, shopping and what is bought: WAIT, REST, BUY, energy drink, ice and heat packs."""

from __future__ import annotations

from typing import Any

from agentspec.envs.deliverybench.world.bag import HEAT, ICE, LABELS
from agentspec.envs.deliverybench.world.bus import first_tick
from agentspec.envs.deliverybench.world.clock import NEVER, ShiftOver, pass_time
from agentspec.envs.deliverybench.world.grammar import Refused, argument, number, short, unread, whole
from agentspec.envs.deliverybench.world.shift import Shift
from agentspec.types import Action

_UNTIL_CHARGED = ("charge_done", "done", "charge")


def wait(world: Shift, action: Action) -> str:
    """WAIT(seconds) or WAIT("charge_done")."""
    state, rules = world.state, world.rules
    value = argument(action, 0, "seconds", "duration_s")
    until = action.kwargs.get("until", value)
    if isinstance(until, str) and until.strip().lower() in _UNTIL_CHARGED:
        if state.charging is None and not rules.hanging_wait:
            raise Refused("WT_NO_SESSION", "nothing is charging: start with CHARGE at a charging station")
        start = state.tick
        pass_time(world, NEVER, charge_ends=True)
        return f"waited {(state.tick - start) / rules.ticks_per_second:.0f}s until charging was done"
    seconds = number(value, action, "seconds")
    if seconds <= 0.0:
        return "waited 0s"
    world.recorder.be_idle("wait", seconds)
    start, rate = state.tick, rules.ticks_per_second
    end = first_tick(start / rate + seconds - 1e-6, start + 1, rate)
    pass_time(world, end, charge_ends=rules.charging_ends_waits)
    return f"waited {(state.tick - start) / rate:.0f}s"


def rest(world: Shift, action: Action) -> str:
    """REST(target_pct=100): regain energy at a rest area, linearly in time."""
    state, rules = world.state, world.rules
    target = number(argument(action, 0, "target_pct"), action, "target_pct", rules.energy_max)
    if not rules.rest_above_full:
        target = min(target, rules.energy_max)
    if world.city.near("rest_area", state.position, rules.nearby) is None:
        raise Refused("RE_NO_AREA", "there is no rest area within 5m: move to one first")
    state.notices.clear()
    before, start, rate = state.energy, state.tick, rules.ticks_per_second
    if target <= before:
        return f"rested to {target:.0f} %"
    world.recorder.prevention["early_rest"] += 1
    seconds = (target - before) / rules.rest_per_min * 60.0
    try:
        pass_time(world, first_tick(start / rate + seconds, start + 1, rate))
    except ShiftOver:
        share = (state.tick - 1 - start) / rate / seconds
        state.energy = before + (target - before) * min(1.0, max(0.0, share))
        raise
    state.energy = target
    return f"rested to {target:.0f} %"


def buy(world: Shift, action: Action) -> str:
    """BUY: each item is bought completely or not at all; one bought item makes the action a success."""
    wishes = _wishes(action)
    state, rules = world.state, world.rules
    if world.city.near("store", state.position, rules.nearby) is None:
        raise Refused("BUY_NO_STORE", "there is no store within 5m: move to one first")
    bought, problems, total = [], [], 0.0
    for item, quantity in wishes.items():
        price = rules.prices.get(item)
        if price is None:
            problems.append(f"unknown item {short(item)} (sold here: {', '.join(rules.prices)})")
            continue
        cost = price * quantity
        if cost > state.balance:
            problems.append(f"{quantity} x {item} cost {cost:.2f}, you have {state.balance:.2f}")
            continue
        world.pay("purchases", -cost)
        total += cost
        state.inventory[item] = state.inventory.get(item, 0) + quantity
        bought.append(f"{quantity} x {item}")
    if not bought:
        raise Refused("BUY_ALL_FAILED", "nothing was bought: " + "; ".join(problems))
    state.notices.clear()
    world.recorder.purchases.append((state.tick, ", ".join(bought), total))
    return "bought " + ", ".join(bought)


def _wishes(action: Action) -> dict[str, int]:
    """Item id -> quantity; entries of the same id are added up."""
    listed = action.kwargs.get("items")
    if listed is None and action.args and isinstance(action.args[0], list):
        listed = action.args[0]
    if listed is not None:
        return _listed(action, listed)
    item = argument(action, 0, "item_id", "item", "name")
    if not isinstance(item, str) or not item.strip():
        raise unread(action, "say what to buy", "BUY_EMPTY")
    quantity = argument(action, 1, "qty")
    count = 1 if quantity is None else whole(quantity, action, "qty")
    if count <= 0:
        raise unread(action, f"qty must be at least 1, not {count}", "BUY_QTY")
    return {item.strip(): count}


def _listed(action: Action, listed: Any) -> dict[str, int]:
    entries = [listed] if isinstance(listed, dict) else listed
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise unread(action, 'items must be a list like [{"item_id": "ice_pack", "qty": 1}]', "BUY_BAD_ITEMS")
    wishes: dict[str, int] = {}
    for entry in entries:
        item = next((entry[key] for key in ("item_id", "name", "item") if entry.get(key)), None)
        quantity = entry.get("qty")
        count = 1 if quantity is None else whole(quantity, action, "qty")
        if isinstance(item, str) and count > 0:
            wishes[item.strip()] = wishes.get(item.strip(), 0) + count
    if not wishes:
        raise unread(action, "the list names nothing to buy", "BUY_EMPTY")
    return wishes


def use_energy_drink(world: Shift, action: Action) -> str:
    """USE_ENERGY_DRINK(): +50 % energy, never above full."""
    state, rules = world.state, world.rules
    if state.energy >= rules.energy_max:
        raise Refused("ED_FULL", f"your energy is {state.energy:.0f} % already: keep the drink for later")
    if state.inventory.get("energy_drink", 0) <= 0:
        raise Refused("ED_NONE", "you have no energy drink: buy one at a store")
    state.inventory["energy_drink"] -= 1
    state.energy = min(rules.energy_max, state.energy + rules.drink_gain)
    state.notices.clear()
    world.recorder.prevention["use_energy_drink"] += 1
    return "used an energy drink"


def use_ice_pack(world: Shift, action: Action) -> str:
    """USE_ICE_PACK(comp): put an ice pack (0 deg C) into a bag compartment."""
    return _use_pack(world, action, "ice_pack", ICE)


def use_heat_pack(world: Shift, action: Action) -> str:
    """USE_HEAT_PACK(comp): put a heat pack (60 deg C) into a bag compartment."""
    return _use_pack(world, action, "heat_pack", HEAT)


def _use_pack(world: Shift, action: Action, item: str, name: str) -> str:
    wish = argument(action, 0, "comp")
    label = wish.strip()[:1].upper() if isinstance(wish, str) else ""
    if not ("A" <= label <= "Z"):
        raise unread(action, "comp must be a compartment letter", "PK_COMP")
    state = world.state
    if state.inventory.get(item, 0) <= 0:
        raise Refused("PK_NONE", f"you have no {item}: buy one at a store")
    if label not in LABELS:
        raise Refused("PK_BAD_COMP", f"there is no compartment {label}; use A, B, C or D")
    state.inventory[item] -= 1
    state.notices.clear()
    state.bag.advance(state.tick)
    state.bag.insert_pack(label, name)
    return f"put {item} into compartment {label}"
