"""The courier's trade: look at offers, accept, pick up, pack, deliver."""

from __future__ import annotations

import math
from collections.abc import Iterable

from agentspec.envs.deliverybench.world.bag import Item
from agentspec.envs.deliverybench.world.clock import look
from agentspec.envs.deliverybench.world.food import toward_ambient
from agentspec.envs.deliverybench.world.grammar import Refused, argument, ids, short, unread, whole
from agentspec.envs.deliverybench.world.notes import HAND, METHODS
from agentspec.envs.deliverybench.world.orders import pick_scores
from agentspec.envs.deliverybench.world.packing import place
from agentspec.envs.deliverybench.world.settlement import settle
from agentspec.envs.deliverybench.world.shift import Shift
from agentspec.envs.deliverybench.world.state import Notice, OrderState
from agentspec.types import Action


def view_orders(world: Shift, action: Action) -> str:
    """VIEW_ORDERS(): the orders on offer appear in the next observation."""
    look(world, "orders", "")
    return "viewed the orders on offer"


def view_bag(world: Shift, action: Action) -> str:
    """VIEW_BAG(): temperatures and contents of the bag appear in the next observation."""
    look(world, "bag", "")
    return "viewed the bag"


def accept_order(world: Shift, action: Action) -> str:
    """ACCEPT_ORDER(ids): accept what is on offer among the ids; fails only when nothing is."""
    value = argument(action, 0, "ids", "order_id", "id", "orders")
    keyword_zero = world.rules.zero_id_fails and not action.args and value in (0, None) and "ids" not in action.kwargs
    if value is None or value == [] or keyword_zero:
        raise unread(action, "say which orders")
    state, rules = world.state, world.rules
    state.notices.clear()
    offered = [number for number in ids(value, action, "ids") if number in state.pool]
    if rules.max_active_orders is not None:
        offered = offered[: max(0, rules.max_active_orders - len(state.orders))]
        if not offered and len(state.orders) >= rules.max_active_orders:
            raise Refused("ACC_FULL", f"you carry {len(state.orders)} orders already: deliver some first")
    if not offered:
        raise Refused("ACC_NONE", f"none of these orders is on offer; on offer: {_numbers(state.pool)}")
    scores = _pick_scores(world)
    for number in offered:
        state.orders[number] = OrderState(world.book[number], state.tick, scores[number])
        state.pool.remove(number)
    world.fill_pool()
    return f"accepted orders {_numbers(offered)}"


def _pick_scores(world: Shift) -> dict[int, float]:
    state = world.state
    anchors = {order.offer.pickup.center for order in state.orders.values()} or {state.position}
    return pick_scores(world.city, [world.book[number] for number in state.pool], sorted(anchors))


def pickup(world: Shift, action: Action) -> str:
    """PICKUP(orders=[...]): take the food of all listed orders that are ready at this restaurant."""
    state, rules = world.state, world.rules
    value = argument(action, 0, "orders", "ids", "order_id")
    if value is None and not rules.bare_pickup_fails:
        value = list(state.orders)
    known = [] if value is None else [n for n in ids(value, action, "orders") if n in state.pool or n in state.orders]
    if not known:
        raise unread(action, f"names none of your orders ({_numbers(state.orders)})", "PU_NO_ORDERS")
    state.notices.clear()
    ready = [state.orders[n] for n in known if n in state.orders and _collectable(world, state.orders[n])]
    if not ready:
        raise Refused("PU_NOTHING", "nothing to pick up here: " + "; ".join(_why_not(world, n) for n in known[:5]))
    world.look()
    for order in ready:
        _take(world, order)
    world.notify("bagging", "put the food into the bag with PLACE_FOOD_IN_BAG")
    numbers = _numbers(order.offer.id for order in ready)
    return f"picked up orders {numbers} at {ready[0].offer.pickup.road}"


def _collectable(world: Shift, order: OrderState) -> bool:
    state, rules = world.state, world.rules
    if order.picked is not None or state.tick - order.accepted < order.offer.prep * rules.ticks_per_second:
        return False
    return math.dist(order.offer.pickup.anchor, state.position) <= rules.pickup_tolerance


def _why_not(world: Shift, number: int) -> str:
    order = world.state.orders.get(number)
    if order is None:
        return f"order {number} is not accepted"
    if order.picked is not None:
        return f"order {number} is picked up already"
    metres = math.dist(order.offer.pickup.anchor, world.state.position) / 100.0
    if metres * 100.0 > world.rules.pickup_tolerance:
        return f"the restaurant of order {number} is {metres:.0f}m away"
    left = order.offer.prep - (world.state.tick - order.accepted) / world.rules.ticks_per_second
    return f"order {number} will be ready in {left:.0f}s"


def _take(world: Shift, order: OrderState) -> None:
    state, rules = world.state, world.rules
    offer = order.offer
    waited = (state.tick - order.accepted) / rules.ticks_per_second - offer.prep
    order.picked = state.tick
    ready_at = order.accepted + offer.prep * rules.ticks_per_second
    for food in offer.foods:
        temp = toward_ambient(food.serving, rules.ambient, rules.food_rate, waited)
        odour = 1.0 if food.smells else 0.0
        item = Item(food.name, food, offer.id, food.capacity, temp, odour, 0, ready_at, state.tick)
        order.items.append(item)
    order.pending = list(order.items)


def place_food_in_bag(world: Shift, action: Action) -> str:
    """PLACE_FOOD_IN_BAG(bag_cmd=): see `packing`."""
    command = argument(action, 0, "bag_cmd", "cmd")
    if not isinstance(command, str) or not command.strip():
        raise unread(action, "the bag command is empty", "BAG_EMPTY")
    state, rules = world.state, world.rules
    state.notices.clear()
    pending = any(order.pending for order in state.orders.values())
    if not pending and rules.vanishing_food:
        return f"bag: {command.strip()}"
    world.look()
    if pending and rules.placing_freezes_food:
        state.bag.detach()
    try:
        place(state.bag, state.orders, command, rules.vanishing_food)
    except Refused:
        world.notify("bagging", "put the food into the bag with PLACE_FOOD_IN_BAG")
        raise
    return f"bag: {command.strip()}"


def drop_off(world: Shift, action: Action) -> str:
    """DROP_OFF(oid, method): deliver at the drop-off door, or into the customer's hands at the hand-off point."""
    oid = argument(action, 0, "oid")
    wish = argument(action, 1, "method")
    if oid is None:
        raise unread(action, "say which order")
    number = whole(oid, action, "oid")
    if not isinstance(wish, str) or not wish.strip():
        raise unread(action, f"say how: {', '.join(METHODS)}", "DO_NO_METHOD")
    method = wish.strip().lower().replace("-", "_").replace(" ", "_")
    if method not in METHODS:
        raise unread(action, f"method must be one of {', '.join(METHODS)}, not {short(wish)}", "DO_BAD_METHOD")
    state, rules = world.state, world.rules
    order = state.orders.get(number)
    if order is None:
        raise Refused("DO_UNKNOWN", f"order {number} is not one of yours ({_numbers(state.orders)})")
    if order.picked is None:
        raise Refused("DO_NOT_PICKED", f"order {number} is not picked up yet")
    offer = order.offer
    at_customer = offer.handoff is not None and math.dist(offer.handoff, state.position) <= rules.nearby
    if method == HAND:
        if not at_customer:
            raise Refused("DO_NOT_AT_CUSTOMER", _no_customer(world, order))
    elif not at_customer and math.dist(offer.dropoff.anchor, state.position) > rules.nearby:
        metres = math.dist(offer.dropoff.anchor, state.position) / 100.0
        raise Refused("DO_NOT_AT_DOOR", f"the door of order {number} is {metres:.0f}m away: move within 5m")
    _deliver(world, order, method)
    return f"delivered order {number} by {method}"


def _no_customer(world: Shift, order: OrderState) -> str:
    point = order.offer.handoff
    if point is None:
        return f"nobody waits outside for order {order.offer.id}: use another method"
    if world.rules.handoff_hidden:
        return f"the customer of order {order.offer.id} is not within 5m of you"
    return f"the customer of order {order.offer.id} waits at ({point[0] / 100:.2f}m, {point[1] / 100:.2f}m)"


def _deliver(world: Shift, order: OrderState, method: str) -> None:
    state, rules = world.state, world.rules
    offer = order.offer
    world.look()
    settlement = settle(
        offer.id,
        pay=offer.pay,
        duration=(state.tick - order.accepted) / rules.ticks_per_second,
        limit=offer.limit,
        methods=offer.methods,
        method=method,
        items=order.items,
        pick_score=order.pick_score,
        rules=rules,
    )
    doomed = {id(item) for item in state.bag.items() if item.food is not None and item.order_id == offer.id}
    if rules.equal_food_vanishes:
        for item in state.bag.items():
            if item.food is not None and any(item.equals(mine) for mine in order.items):
                doomed.add(id(item))
    state.bag.remove(doomed)
    del state.orders[offer.id]
    world.pay("orders", settlement.paid)
    state.settlements.append(settlement)
    state.error = ""
    facts = {"id": offer.id, "paid": settlement.paid, "stars": settlement.stars}
    state.notices.append(Notice("settled", f"order {offer.id}: {settlement.stars} stars", facts))


def _numbers(numbers: Iterable[int]) -> str:
    return ", ".join(str(n) for n in numbers) or "none"
