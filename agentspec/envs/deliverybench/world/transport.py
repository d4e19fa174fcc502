"""Moving: how a body follows a route, in closed form, and what each way of travelling costs.

The follower walks straight towards the current waypoint at constant speed and takes the next one as soon as it is
within ``tolerance`` (5 m) of it, so corners are cut. A move is reported complete at the first tick at which the body is
within that tolerance of the requested point; afterwards it creeps on until ``stop_radius`` (1.366 m) from the last
waypoint. Between two waypoints nothing changes, so the number of ticks of each leg is computed, never counted:

    ticks of a leg = ceil((distance to waypoint - tolerance) / length of one tick's step)
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Point = tuple[float, float]

_SLACK = 1e-9
"""Quotients this close to an integer count as it: the step sizes are decimal fractions and would round either way."""


class Follower:
    """A body on its way along ``waypoints`` (cm), ``step`` cm per tick.

    Attributes:
        x, y: the current position. ux, uy: the direction of the last movement (0, 0 before the first).
        travelled: total length of the way so far (cm).
    """

    __slots__ = ("_next", "step", "stop_radius", "tolerance", "travelled", "ux", "uy", "waypoints", "x", "y")

    def __init__(
        self, start: Point, waypoints: Sequence[Point], step: float, tolerance: float, stop_radius: float
    ) -> None:
        self.x, self.y = start
        self.waypoints = waypoints
        self.step = step
        self.tolerance = tolerance
        self.stop_radius = stop_radius
        self.ux = self.uy = 0.0
        self.travelled = 0.0
        self._next = 0

    def run(self, target: Point, max_ticks: int) -> tuple[int, bool]:
        """Walk until within tolerance of ``target``, at most ``max_ticks`` ticks; returns (ticks, arrived)."""
        # The innermost loop of the simulation, hence local variables and no calls of own methods.
        waypoints, step, reach = self.waypoints, self.step, self.tolerance
        i, last, used = self._next, len(waypoints) - 1, 0
        x, y = self.x, self.y
        tx, ty = target
        arrived = False
        while used < max_ticks:
            dx, dy = waypoints[i][0] - x, waypoints[i][1] - y
            distance = math.hypot(dx, dy)
            while distance <= reach and i < last:
                i += 1
                dx, dy = waypoints[i][0] - x, waypoints[i][1] - y
                distance = math.hypot(dx, dy)
            left = distance - (self.stop_radius if distance <= reach else reach)
            if left <= 0.0:
                break
            ux, uy = dx / distance, dy / distance
            ticks = math.ceil(left / step - _SLACK) or 1
            ticks = min(ticks, max_ticks - used)
            # Does the body pass within reach of the target on this leg?
            wx, wy = tx - x, ty - y
            ahead = wx * ux + wy * uy
            room_sq = reach * reach - (wx * wx + wy * wy - ahead * ahead)
            if room_sq >= 0.0:
                half = math.sqrt(room_sq)
                first = max(1, math.ceil((ahead - half) / step - _SLACK))
                if first <= ticks and first * step <= ahead + half + _SLACK:
                    ticks, arrived = first, True
            x += ux * ticks * step
            y += uy * ticks * step
            used += ticks
            self.ux, self.uy = ux, uy
            if arrived:
                break
        self.x, self.y, self._next = x, y, i
        self.travelled += used * step
        return used, arrived

    def settle(self, max_ticks: int) -> int:
        """Creep on to the stop radius of the last waypoint, at most ``max_ticks`` ticks; returns the ticks it takes.

        The last step may be shorter than the others.
        """
        used, last = 0, len(self.waypoints) - 1
        while used < max_ticks:
            distance = self._aim()
            if self._next == last and distance <= self.tolerance:
                rest = distance - self.stop_radius
                if rest <= 0.0:
                    return used
                ticks = max(1, math.ceil(rest / self.step - _SLACK))
                if used + ticks > max_ticks:
                    self._walk((max_ticks - used) * self.step)
                    return max_ticks
                self._walk(rest)
                return used + ticks
            ticks = max(1, math.ceil((distance - self.tolerance) / self.step - _SLACK))
            ticks = min(ticks, max_ticks - used)
            self._walk(ticks * self.step)
            used += ticks
        return used

    def _aim(self) -> float:
        """Turn towards the first waypoint out of reach (or the last one); the distance to it."""
        waypoints, last = self.waypoints, len(self.waypoints) - 1
        while True:
            wx, wy = waypoints[self._next]
            dx, dy = wx - self.x, wy - self.y
            distance = math.hypot(dx, dy)
            if distance > self.tolerance or self._next == last:
                break
            self._next += 1
        if distance > 0.0:
            self.ux, self.uy = dx / distance, dy / distance
        return distance

    def _walk(self, length: float) -> None:
        self.x += self.ux * length
        self.y += self.uy * length
        self.travelled += length


def heading(ux: float, uy: float) -> float:
    """Yaw in degrees (0 = +x, 90 = +y) of a direction, in [0, 360)."""
    return math.degrees(math.atan2(uy, ux)) % 360.0


def ticks_until_empty(level: float, per_tick: float) -> int | None:
    """Ticks until a level falling by ``per_tick`` reaches 0; None if it never does."""
    if per_tick <= 0.0:
        return None
    return max(1, math.ceil(level / per_tick - _SLACK))


def sent(point: Point) -> Point:
    """A point as sent to the body: two decimals of a centimetre."""
    return (round(point[0], 2), round(point[1], 2))


def waypoints_of(route: Sequence[Point]) -> list[Point]:
    """A route as sent to the body, without the starting point."""
    return [(round(x, 2), round(y, 2)) for x, y in route[1:]] or [route[0]]
