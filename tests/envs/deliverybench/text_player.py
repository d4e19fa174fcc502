"""A courier who can read, and nothing else: the oracle in the model's seat.

`answer` is a scripted model. It is given the messages a language model would be given and looks at nothing but their
text: no state, no map, no code of the environment. What it knows about the world it has read there. If it earns well,
the prompts carry what a model needs; if a sentence of them changes, its regular expressions say so.

Its rules, first match first:

1. Hand over, pack or fetch where the section "Here you can" says how.
2. Drink when tired; fetch a car while that pays, else keep the scooter charged.
3. Look at the board while there is room for orders, and accept those that make the round worth more.
4. Go to the next stop of the round; wait there for the food. With an empty round, wait.

The round is an insertion heuristic: an order's two stops go where they cost least, and an order is worth taking if the
round pays more with it than without, at a price of time. Ways between two places are guessed as city blocks.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from agentspec.llm.base import Request

Point = tuple[float, float]

SECOND, METRE = 0.05, 0.003
"""What a second and a metre are worth (dollars): about what an hour of good work brings."""
STOP_S = 4.0
COOKING_S = 240.0
"""Of an order that is only on offer: the middle of what the rules say."""
BONUS = 2.0
"""Expected tip of an order in time ("up to $3 for five stars")."""
GAIN = 0.5
"""What an order must add to a round (dollars)."""
ROOM = 6
TIRED, LOW_M = 35.0, 500.0
CAR_FROM_S = 1200.0

_AT = r"\((-?[\d.]+)m, (-?[\d.]+)m\)"
_TIME = r"((?:\d+ (?:h|min|s) ?)+)"
_UNITS = {"h": 3600.0, "min": 60.0, "s": 1.0}


@dataclass(frozen=True)
class Order:
    """An order of one's own or on offer. Times in seconds from now, ways in metres."""

    id: int
    pay: float
    left: float
    ready: float
    carried: bool
    pickup: Point
    dropoff: Point


@dataclass(frozen=True)
class Scene:
    """What one observation says."""

    left: float
    position: Point
    mode: str
    energy: float
    balance: float
    range: float
    goods: dict[str, int]
    orders: list[Order]
    offers: list[Order] | None
    hints: list[str]
    nearest: dict[str, tuple[Point, float]]
    """Kind of place -> where the nearest is, and the way there (0: here)."""
    car: bool


# -- reading -----------------------------------------------------------------------------------------------------------


def seconds(text: str) -> float:
    """`1 h 20 min`, `3 min 5 s`, `40 s`."""
    return sum(float(n) * _UNITS[unit] for n, unit in re.findall(r"(\d+) (h|min|s)", text))


def point(match: re.Match[str], group: int) -> Point:
    return float(match[group]), float(match[group + 1])


def section(text: str, title: str) -> list[str]:
    """The lines of a titled list; empty where there is none."""
    found = re.search(rf"^{title}:\n((?:- .*\n?)+)", text, re.MULTILINE)
    return [line[2:] for line in found[1].splitlines()] if found else []


def must(pattern: str, text: str) -> re.Match[str]:
    found = re.search(pattern, text)
    assert found, f"the prompt does not say {pattern!r}:\n{text}"
    return found


def own_order(line: str) -> Order:
    head = must(r"^order (\d+): (ready in|ready|in hand|in bag)", line)
    left = must(rf"{_TIME} ?(left|late)", line)
    carried = head[2].startswith("in ")
    drop = must(rf"[dD]rop-off .*?{_AT}", line)
    in_person = re.search(rf"customer waits at {_AT}", line)
    pickup = drop if carried else must(rf"Pick-up .*?{_AT}", line)
    return Order(
        id=int(head[1]),
        pay=float(must(r"pays \$([\d.]+\d)", line)[1]),
        left=seconds(left[1]) * (1.0 if left[2] == "left" else -1.0),
        ready=seconds(must(rf"ready in {_TIME}", line)[1]) if head[2] == "ready in" else 0.0,
        carried=carried,
        pickup=point(pickup, 1),
        dropoff=point(in_person or drop, 1),
    )


def offered(line: str) -> Order:
    found = must(rf"^order (\d+): \$([\d.]+), \d+m, {_TIME}\. From .*?{_AT}.* to {_AT}", line)
    return Order(
        id=int(found[1]),
        pay=float(found[2]),
        left=seconds(found[3]),
        ready=COOKING_S,
        carried=False,
        pickup=point(found, 4),
        dropoff=point(found, 6),
    )


def scene(text: str) -> Scene:
    """Read the newest observation in `text`."""
    text = text[text.rindex(" on the clock") - 8 :]
    offers = section(text, "Orders on offer")
    nearest = {}
    for name, x, y, way in re.findall(rf"(\w+) \d+ {_AT} (here|\d+m)", must(r"nearest: (.*)", text)[1]):
        nearest[name] = ((float(x), float(y)), 0.0 if way == "here" else float(way[:-1]))
    return Scene(
        left=seconds(must(rf"on the clock, {_TIME} ?left", text)[1]),
        position=point(must(rf"You are .*?{_AT}", text), 1),
        mode=must(r"You are .*?\), (on foot|by e-scooter|dragging the scooter|in the rented car)", text)[1],
        energy=float(must(r"Energy (\d+) %", text)[1]),
        balance=float(must(r"Balance \$(-?[\d.]+)", text)[1]),
        range=float(must(r"Scooter battery \d+ % \((\d+)m\)", text)[1]),
        goods={name: int(n) for n, name in re.findall(r"(\d+) (\w+)", must(r"You carry (.*?)\.", text)[1])},
        orders=[own_order(line) for line in section(text, "Your orders")],
        offers=[offered(line) for line in offers] if offers else None,
        hints=section(text, "Here you can"),
        nearest=nearest,
        car="Car rented" in text,
    )


# -- planning ----------------------------------------------------------------------------------------------------------

Stop = tuple[Order, bool]
"""An order, and whether this is its drop-off."""


def blocks(a: Point, b: Point) -> float:
    """The way between two places along the blocks of a city (metres)."""
    return abs(a[0] - b[0]) + abs(a[1] - b[1])


def place(stop: Stop) -> Point:
    return stop[0].dropoff if stop[1] else stop[0].pickup


def worth(stops: Sequence[Stop], seen: Scene, speed: float) -> float:
    """What a round earns (dollars), less the price of its time and ways."""
    here, now, value = seen.position, 0.0, 0.0
    for order, delivers in stops:
        goal = place((order, delivers))
        way = blocks(here, goal)
        value -= METRE * way
        now += way / speed + (STOP_S if way > 5.0 else 0.0)
        here = goal
        if not delivers:
            now = max(now, order.ready)
        elif now <= seen.left - 10.0:
            value += order.pay + BONUS if now <= order.left else order.pay * 0.6 - 2.0
    return value - SECOND * now


def inserted(stops: list[Stop], order: Order, seen: Scene, speed: float) -> list[Stop]:
    """The best round with the stops of one more order."""
    rounds = []
    for j in range(len(stops) + 1):
        after = [*stops[:j], (order, True), *stops[j:]]
        rounds += [after] if order.carried else [[*after[:i], (order, False), *after[i:]] for i in range(j + 1)]
    return max(rounds, key=lambda stops: worth(stops, seen, speed))


def plan(seen: Scene, speed: float) -> list[Stop]:
    """The round of all own orders, most urgent first."""
    stops: list[Stop] = []
    for order in sorted(seen.orders, key=lambda order: order.left):
        stops = inserted(stops, order, seen, speed)
    return stops


def wanted(seen: Scene, stops: list[Stop], speed: float) -> list[int]:
    """Which of the offers to take: each time the one that adds most, while it adds anything."""
    offers, taken = list(seen.offers or ()), []
    while offers and len(seen.orders) + len(taken) < ROOM:
        before = worth(stops, seen, speed)
        tried = [(inserted(stops, offer, seen, speed), offer) for offer in offers]
        best, offer = max(tried, key=lambda pair: worth(pair[0], seen, speed))
        if stops and worth(best, seen, speed) <= before + GAIN:
            break  # With nothing to do, any order is better than none.
        stops = best
        taken.append(offer.id)
        offers.remove(offer)
    return taken


# -- acting ------------------------------------------------------------------------------------------------------------


def move(goal: Point) -> str:
    return f"MOVE({goal[0]}m, {goal[1]}m)"


def visit(where: tuple[Point, float], there: str) -> str:
    """Go to a place, and do something there."""
    return move(where[0]) if where[1] else there


def call_in(hint: str) -> str:
    """The call that a hint spells out."""
    return must(r"[A-Z_]{3,}\((?:[^()\"]|\"[^\"]*\")*\)", hint)[0]


def hint(seen: Scene, *beginnings: str) -> str | None:
    """The call of the first hint that begins like this."""
    found = next((h for begin in beginnings for h in seen.hints if h.startswith(begin)), None)
    return None if found is None else call_in(found)


def strength(seen: Scene) -> str | None:
    """Drink when tired; keep two drinks."""
    drinks, store = seen.goods.get("energy_drink", 0), seen.nearest.get("store")
    if seen.energy <= 50.0 and drinks:
        return "USE_ENERGY_DRINK()"
    if store is None or drinks >= 2 or seen.balance < 12.0:
        return None
    passing = not store[1] and seen.left > 900.0
    return visit(store, 'BUY(item_id="energy_drink", qty=2)') if passing or seen.energy <= TIRED else None


def vehicle(seen: Scene) -> str | None:
    """A car while it pays, else the scooter with a charged battery."""
    store, rental = seen.nearest.get("store"), seen.nearest.get("car_rental")
    if rental and not seen.car and seen.left >= CAR_FROM_S + rental[1] / 6.0 and seen.balance >= 30.0:
        return visit(rental, "RENT_CAR()")
    if seen.mode == "on foot":
        return hint(seen, "your car stands here", "your scooter stands here")
    if seen.car or seen.range >= LOW_M or store is None:
        return None
    if seen.goods.get("escooter_battery_pack"):
        return "USE_BATTERY_PACK()"
    worthwhile = seen.balance >= 15.0 and seen.left > 300.0
    return visit(store, 'BUY(item_id="escooter_battery_pack", qty=1)') if worthwhile else None


def decide(seen: Scene) -> str:
    """The next action."""
    urgent = hint(seen, "deliver", "pack", "fetch") or strength(seen) or vehicle(seen)
    if urgent:
        return urgent
    speed = 12.0 if seen.car else 6.0
    stops = plan(seen, speed)
    if len(seen.orders) < ROOM and seen.left > 150.0:
        if seen.offers is None:
            return "VIEW_ORDERS()"
        taken = wanted(seen, stops, speed)
        if taken:
            return f"ACCEPT_ORDER([{', '.join(map(str, taken))}])"
    if not stops:
        return "WAIT(30)"
    goal = place(stops[0])
    if blocks(seen.position, goal) > 5.0:
        return move(goal)
    return f"WAIT({max(1.0, stops[0][0].ready):g})"


def answer(request: Request) -> str:
    """The scripted model: an action, dressed as the prompt asks for it."""
    read = "\n".join(message.text for message in request.messages if message.role == "user")
    action = decide(scene(read))
    asked = request.messages[0].text + request.messages[-1].text
    return f"Thought: this is the best next step of my round.\nAction: {action}" if "Action: NAME" in asked else action
