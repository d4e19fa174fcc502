"""Scripted couriers: the strong rule-based one, and the random one that marks the floor.

The rule-based courier keeps a round (see `planning`), takes offers that make it worth more, and looks after vehicle and
energy (see `errands`). It sees what an agent could see: the view in `info["state"]`, and the city's streets, which an
agent has as a map. It reads a customer's note as an attentive reader would, and knows the restaurants' dishes.

Both answer with a native call, or in menu mode with the text of one of the choices, so that a run of the rule-based
courier is a demonstration in either language.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from agentspec.envs.deliverybench.city.citymap import City
from agentspec.envs.deliverybench.city.geometry import polyline_length
from agentspec.envs.deliverybench.expert import errands
from agentspec.envs.deliverybench.expert.errands import Upkeep
from agentspec.envs.deliverybench.expert.matching import match
from agentspec.envs.deliverybench.expert.planning import Job, Planner, Point, Stop
from agentspec.envs.deliverybench.view import calls
from agentspec.envs.deliverybench.view.calls import View, within_reach
from agentspec.envs.deliverybench.view.cards import IN_BAG, IN_HAND, READY
from agentspec.envs.deliverybench.view.menu import MORE, options

MEMO_LIMIT = 100_000
PAUSE_S = 10.0
IDLE_S = 60.0


@dataclass(frozen=True)
class Style:
    """How a courier values things: dollars per second, per metre and per action (where actions are limited), and what a
    new order must add.

    `hasty` moves at the accelerated pace while nothing fragile is carried; `bagging` packs food into the bag (without
    it, food is carried in the hand, and under fair rules on foot).
    """

    second: float = 0.07
    idle: float = 0.01
    metre: float = 0.003
    call: float = 0.4
    margin: float = 1.5
    hasty: bool = True
    bagging: bool = True
    max_orders: int = 8
    upkeep: Upkeep = field(default_factory=Upkeep)


class RuleBasedCourier:
    """Insertion heuristic with deadlines over all open orders and offers.

    Args:
        city: the city the episode runs in.
        style: see `Style`.
    """

    def __init__(self, city: City, style: Style | None = None) -> None:
        self.city = city
        self.style = style or Style()
        self.round: list[Stop] = []
        self._last = ""
        self._taken: list[int] = []
        self._memo: tuple[dict[tuple[Point, Point], float], dict[tuple[Point, Point], float]] = ({}, {})

    # -- the interface -----------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget the round; call at the start of an episode."""
        self.round, self._last, self._taken = [], "", []

    def act(self, info: Mapping[str, Any]) -> str:
        """The next action for `info` of reset or step: one of the menu's texts if there is a menu, else a call."""
        view = info["state"]
        if info["action_schema"].choices:
            return self.choose(view, info["action_schema"].choices)
        action = self.call(view)
        if action == self._last and view["error"]:
            # What has just been refused is not tried again at once.
            action = calls.wait(PAUSE_S)
        self._last = action
        return action

    def snapshot(self) -> bytes:
        """The round, the last action and the offers still to accept, for `restore`."""
        return json.dumps([self._last, self._taken, [[s.job, s.kind, list(s.place)] for s in self.round]]).encode()

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`."""
        self._last, self._taken, stops = json.loads(blob)
        self.round = [Stop(job, kind, (place[0], place[1])) for job, kind, place in stops]

    # -- native actions ----------------------------------------------------------------------------------------

    def call(self, view: View, menu: bool = False) -> str:
        """The next native call; from a `menu` offers are accepted one at a time, which costs actions."""
        style = self.style
        self._taken = []
        action = self._at_hand(view) or errands.refresh(view, style.upkeep) or self._mount(view)
        if action is not None:
            return action
        car = errands.wants_car(view, style.upkeep)
        start, planner = self._planner(view, car)
        planner.per_offer = int(menu)
        active = [self._job(order) for order in view["orders"]]
        _, self.round = planner.build(start, active, self.round)
        self._taken = self._take(view, planner, start)
        if self._taken:
            return calls.accept(self._taken)
        if car and self.round:
            return errands.fetch_car(view)
        return self._go_on(view)

    def _at_hand(self, view: View) -> str | None:
        """What can be done without moving: pack, deliver, pick up."""
        orders = view["orders"]
        for order in orders:
            if order["status"] in (IN_BAG, IN_HAND) and within_reach(view, calls.handover(order)[1]):
                return calls.deliver(order)
        hand = [order for order in orders if order["status"] == IN_HAND]
        if hand and self.style.bagging:
            return calls.bag(view, hand)
        ready = [o["id"] for o in orders if o["status"] == READY and within_reach(view, o["pickup_xy"])]
        return calls.pick_up(ready) if ready else None

    def _mount(self, view: View) -> str | None:
        """Get on a vehicle, or off it where food in the hand has to be carried on foot."""
        if view["hands_must_be_free"] and calls.hands_full(view):
            return None if view["mode"] == "walk" else 'SWITCH(to="walk")'
        return errands.regain(view)

    def _take(self, view: View, planner: Planner, start: Point) -> list[int]:
        room = min(self.style.max_orders - len(view["orders"]), 99 if view["room"] is None else view["room"])
        if room <= 0:
            return []
        return self._choose(planner, start, view["offers"], room)

    def _choose(self, planner: Planner, start: Point, offers: Sequence[Mapping[str, Any]], room: int) -> list[int]:
        """Ids of the offers to take, in order of choice; the round then serves them."""
        jobs = [self._job(offer) for offer in offers]
        taken, plan = planner.choose(start, self.round, jobs, room, self.style.margin)
        if not taken and not plan:
            # Idle time is worth little: with nothing to do, any order that pays for its way is welcome.
            planner = replace(planner, second=0.2 * planner.second, idle=0.0, call=0.2 * planner.call)
            taken, plan = planner.choose(start, plan, jobs, room, 0.0)
        self.round = plan
        return taken

    def _go_on(self, view: View) -> str:
        """Travel to the next stop, by way of a store or charger if needed; wait there for the food."""
        upkeep = self.style.upkeep
        if not self.round:
            errand = errands.shopping(view, upkeep, None, 0.0) or errands.close_car(view)
            return errand or calls.wait(self._idle(view))
        goal = self.round[0].place
        leg = self._metres(view["mode"] == "car", _point(view["position"]), goal)
        errand = errands.shopping(view, upkeep, goal, leg) or errands.power(view, leg)
        if errand is not None:
            return errand
        if within_reach(view, goal):
            order = next(o for o in view["orders"] if o["id"] == self.round[0].job)
            return calls.wait(max(1.0, order["ready_in_s"]))
        return calls.move(goal, self._pace(view))

    def _idle(self, view: View) -> float:
        """Seconds to wait where no order is worth taking: to the end of the shift; a minute where actions are limited,
        because the episode ends with them and not with the shift."""
        left = max(1.0, view["left_s"])
        return left if view["calls_left"] is None else min(left, IDLE_S)

    def _pace(self, view: View) -> str:
        return "normal" if not self.style.hasty or calls.fragile_carried(view) else "accel"

    # -- planning ----------------------------------------------------------------------------------------------

    def _planner(self, view: View, car: bool) -> tuple[Point, Planner]:
        """Where the round begins, and a planner with the prices of the vehicle in use (or about to be rented)."""
        style = self.style
        driving = car or view["mode"] == "car"
        start, delay = _point(view["position"]), 0.0
        speed = 12.0 if driving else view["speed"]
        if car:
            rental = view["nearest"]["car_rental"]
            start, delay = _point(rental["xy"]), rental["m"] / view["speed"]
        metre = style.metre if driving else style.metre + 0.004
        planner = Planner(
            metres=self._ways(driving),
            speed=speed * (1.1 if style.hasty else 1.0),
            second=style.second,
            idle=style.idle,
            metre=metre,
            call=0.0 if view["calls_left"] is None else style.call,
            delay=delay,
            horizon=view["left_s"] - 5.0,
            actions=math.inf if view["calls_left"] is None else view["calls_left"],
            per_pickup=2 if style.bagging else 1,
        )
        return start, planner

    def _job(self, card: Mapping[str, Any]) -> Job:
        offered = "status" not in card
        picked = not offered and card["status"] in (IN_BAG, IN_HAND)
        ready = calls.prep_seconds(card["items"]) if offered else card["ready_in_s"]
        return Job(
            id=card["id"],
            pickup=_point(card["pickup_xy"]),
            dropoff=_point(calls.handover(card)[1]),
            pay=card["pay"],
            limit=card["limit_s"],
            ready=ready,
            elapsed=0.0 if offered else card["elapsed_s"],
            picked=picked,
        )

    def _metres(self, driving: bool, a: Point, b: Point) -> float:
        return self._ways(driving)(a, b)

    def _ways(self, driving: bool) -> Callable[[Point, Point], float]:
        """The length of the way between two points (metres), by car or not; looked up where it is known."""
        memo = self._memo[driving]
        if len(memo) >= MEMO_LIMIT:
            memo.clear()
        route = self.city.car_route if driving else self.city.walk_route

        def metres(a: Point, b: Point) -> float:
            found = memo.get((a, b))
            if found is None:
                points = route((a[0] * 100.0, a[1] * 100.0), (b[0] * 100.0, b[1] * 100.0))
                found = memo[a, b] = polyline_length(points) / 100.0
            return found

        return metres

    # -- the menu ----------------------------------------------------------------------------------------------

    def choose(self, view: View, shown: Sequence[str]) -> str:
        """The choice of the menu that stands for the next native call; `MORE` where it is on another page.

        Offers that were chosen together are accepted one after the other, without planning anew in between.
        """
        known = options(view)
        offered = {number for option in known if option.kind == "accept" for number in calls.numbers_in(option.call)}
        view = {**view, "offers": [offer for offer in view["offers"] if offer["id"] in offered]}
        self._taken = [number for number in self._taken if number in offered]
        if self._taken:
            call = calls.accept(self._taken)
        else:
            call = self.call(view, menu=True)
            if call == self._last and view["error"]:
                call = calls.wait(PAUSE_S)
        self._last = call
        wanted = match(call, known, self._taken)
        return wanted if wanted in shown or MORE.text not in shown else MORE.text


def _point(xy: Sequence[float]) -> Point:
    return (xy[0], xy[1])


__all__ = ["RuleBasedCourier", "Style"]
