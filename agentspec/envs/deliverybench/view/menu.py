"""The menu: the concrete actions that make sense now, as short stable texts, best first and a page at a time.

A small model cannot write `MOVE(120.5m, -48m)` from nothing, but it can learn *what to do next*. In menu mode the
environment shows at most twelve choices, each a text such as "pick up order 3" and each standing for exactly one native
call that succeeds now. Everything that earns is among them: several orders at once, both paces, car, bus, charging to a
level, shops and what they sell, rest. What does not fit on the first page stands on the next ones; "more choices" turns
the page and takes no time. The texts share their beginnings, so that decoding token by token branches in few places,
and no two of one menu are equal.
"""

from __future__ import annotations

from collections.abc import Sequence

from agentspec.envs.deliverybench.view import calls, choices, upkeep
from agentspec.envs.deliverybench.view.calls import View, within_reach
from agentspec.envs.deliverybench.view.choices import Option

MAX_CHOICES = 12
MAX_WAYS, MAX_OFFERS = 5, 3
"""Ways and offers on the first page, which is kept short; the others follow."""

LOW_BATTERY, LOW_ENERGY, THIRSTY = 40.0, 40.0, 50.0
CAR_FROM_S, CAR_MONEY, CAR_ACTIONS = 900.0, 30.0, 40
MORE = Option("more choices", "", "more")


def options(view: View) -> list[Option]:
    """All choices, best first."""
    first, others = _ranked(view)
    return first + others


def pages(view: View) -> list[list[Option]]:
    """The choices in pages of at most `MAX_CHOICES`, each ending with `MORE`; the first is as short as it can be."""
    first, others = _ranked(view)
    size = MAX_CHOICES - 1
    # The short wait closes the first page: it is always there, and always at the end.
    *rest, wait = first
    others = rest[size - 1 :] + others
    page = [*rest[: size - 1], wait, MORE]
    return [page, *([*others[i : i + size], MORE] for i in range(0, len(others), size))]


def _ranked(view: View) -> tuple[list[Option], list[Option]]:
    """What belongs onto the first page, and the rest; equal texts and calls once."""
    ways = choices.ways(view)
    offered = choices.offers(view)
    care, later = _care(view)
    rent = _car_pays(view)
    cars = upkeep.car(view)
    waits = upkeep.waits(view)
    work, patience = choices.work_here(view)
    first = [
        *work,
        *patience[:1],
        *upkeep.mounts(view),
        *(cars if rent else ()),
        *(way for way, _ in ways[:MAX_WAYS]),
        *offered[:MAX_OFFERS],
        *care,
        *([waits[-1]] if not view["orders"] and not offered else ()),
        waits[0],
    ]
    others = [
        *patience[1:],
        *(way for way, _ in ways[MAX_WAYS:]),
        *offered[MAX_OFFERS:],
        *later,
        *(way for _, way in ways),
        *cars,
        *upkeep.bus(view),
        *upkeep.on_foot(view),
        *waits[1:],
    ]
    if calls.hands_full(view) and view["hands_must_be_free"] and view["mode"] != "walk":
        # No vehicle moves with food in the hand: it is packed before the courier goes on.
        first, others = _standing(first), _standing(others)
    unique = {option.text: option for option in reversed(first + others)}
    keep = [unique.pop(option.text) for option in first if option.text in unique]
    return keep, [unique.pop(option.text) for option in others if option.text in unique]


def _standing(group: Sequence[Option]) -> list[Option]:
    return [option for option in group if not option.call.startswith("MOVE")]


def _car_pays(view: View) -> bool:
    """Whether renting a car is worth a place on the first page."""
    rental = view["nearest"].get("car_rental")
    if view["car"] is not None or rental is None or view["balance"] < CAR_MONEY:
        return False
    if view["calls_left"] is not None and view["calls_left"] < CAR_ACTIONS:
        return False
    return bool(view["left_s"] - rental["m"] / view["speed"] >= CAR_FROM_S)


def _care(view: View) -> tuple[list[Option], list[Option]]:
    """Battery, energy and shopping: what matters now, and the rest."""
    now: list[Option] = []
    later: list[Option] = []
    scooter = view["mode"] in ("e-scooter", "drag_scooter")
    low = scooter and view["battery"] <= LOW_BATTERY
    tired = view["energy"] <= LOW_ENERGY
    for option in upkeep.using(view):
        wanted = view["energy"] <= THIRSTY if "drink" in option.text else low
        (now if wanted and "into" not in option.text else later).append(option)
    for group, wanted in ((upkeep.charging(view), low), (upkeep.resting(view), tired)):
        (now if wanted else later).extend(group)
    store = view["nearest"].get("store")
    visiting = store is not None and within_reach(view, store["xy"])
    for option in upkeep.shopping(view):
        drink, pack = option.text == "buy energy drink", option.text == "buy battery pack"
        urgent = drink or (pack and low) if visiting else (tired or low) and not view["inventory"]
        (now if urgent else later).append(option)
    return now, later


__all__ = ["MAX_CHOICES", "MORE", "Option", "options", "pages"]
