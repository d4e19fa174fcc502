"""The bus: a line, a timetable that is a pure function of the clock, and what waits at which stop.

There is one bus. It waits at a stop for the dwell time, drives to the next one, and turns round at the end of the line.
Nothing a courier does changes it, so the whole timetable is computed once per city (and extended on demand), and a
world stores nothing of it: the state at a tick is looked up. The bus has no position between stops; while it
moves it still shows at the stop it left.

The original builds its line by interleaving path corners and stops and always looks for stop k at point 2k+1, which
after the first turn is only right when the path has exactly one point more than there are stops; it also makes the
terminal the first stop of the way back. ``Rules.odd_bus_line`` keeps both; otherwise the bus drives the true line.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from dataclasses import dataclass

from agentspec.envs.deliverybench.world.rules import Rules

Point = tuple[float, float]

_extending = threading.Lock()
"""Held while a timetable grows; not a timetable's own, so that worlds can be copied and pickled."""


@dataclass(frozen=True, slots=True)
class BusPhase:
    """What the bus does from ``tick`` on: stopped at ``stop``, or moving to ``target`` (names; "" for none).

    ``position`` in cm; ``until`` is the second at which the bus leaves (stopped) or arrives (moving). ``index`` is the
    position of ``stop`` in the current direction of travel (-1 before the first stop), ``direction`` +1 or -1.
    """

    tick: int
    stopped: bool
    stop: str
    target: str
    position: Point
    until: float
    since: float
    index: int
    direction: int


@dataclass(frozen=True, slots=True)
class Line:
    """One direction of travel: stop names and positions, all points of the way, and where the stops are among them."""

    names: tuple[str, ...]
    stops: tuple[Point, ...]
    points: tuple[Point, ...]
    at: tuple[int, ...]

    def reversed(self, exact: bool) -> Line:
        """The way back; ``exact`` puts the stops where they truly are instead of at points 2k+1."""
        n = len(self.points)
        at = tuple(n - 1 - i for i in reversed(self.at)) if exact else self.at
        return Line(self.names[::-1], self.stops[::-1], self.points[::-1], at)


class BusTimetable:
    """The phases of the one bus of a line, computed as far as they have been asked for.

    Args:
        names, stops: the stops in the order of the line (cm).
        points: corners and stops interleaved (cm), the bus starts at the first.
        rules: speed, dwell time, ticks and ``odd_bus_line``.
    """

    bus_id = "bus_1"

    def __init__(self, names: tuple[str, ...], stops: tuple[Point, ...], points: tuple[Point, ...], rules: Rules):
        self.names = names
        self.stops = stops
        self._rules = rules
        at = tuple(min(2 * k + 1, len(points) - 1) for k in range(len(stops)))
        self._line = Line(names, stops, points, at)
        self._cursor = 0
        self._direction = 1
        self._ticks: list[int] = []
        self._phases: list[BusPhase] = []
        if stops:
            self._drive(0, points[0], 0, "", -1)

    def __deepcopy__(self, memo: object) -> BusTimetable:
        """Itself: a timetable is a function of the clock, and copies of a world share it."""
        return self

    def phase(self, tick: int) -> BusPhase | None:
        """The phase at ``tick``; None for a city without a bus."""
        if not self._phases:
            return None
        self._extend(tick)
        return self._phases[bisect_right(self._ticks, tick) - 1]

    def arrival(self, stop: str, tick: int) -> int:
        """The first tick >= ``tick`` at which the bus stands at ``stop`` (which must be on the line)."""
        if stop not in self.names:
            raise ValueError(f"no stop {stop!r} on this line; expected one of {', '.join(self.names)}")
        self._extend(tick)
        i = bisect_right(self._ticks, tick) - 1
        while True:
            if i == len(self._phases):
                self._extend(self._ticks[-1])
            phase = self._phases[i]
            if phase.stopped and phase.stop == stop:
                return max(tick, phase.tick)
            i += 1

    def _extend(self, tick: int) -> None:
        """Compute phases until one begins after ``tick``; worlds in several threads may share the timetable."""
        if self._ticks[-1] > tick:
            return
        with _extending:
            while self._ticks[-1] <= tick:
                self._next()

    def _next(self) -> None:
        last = self._phases[-1]
        rate = self._rules.ticks_per_second
        if not last.stopped:
            tick = first_tick(last.until, last.tick + 1, rate)
            self._stop(tick, last.target)
            return
        tick = last.tick + 1
        dwell = self._rules.bus_dwell
        tick = max(tick, round((last.since + dwell) * rate) - 2)
        while tick / rate - last.since < dwell:
            tick += 1
        target = last.index + 1
        if target < len(self._line.stops):
            self._drive(tick, last.position, target, last.stop, last.index)
            return
        self._line = self._line.reversed(not self._rules.odd_bus_line)
        self._direction = -self._direction
        if self._rules.odd_bus_line:
            self._cursor = 0
            self._drive(tick, last.position, 0, "", -1)
        else:
            self._cursor = self._line.at[0]
            self._drive(tick, last.position, min(1, len(self._line.stops) - 1), last.stop, 0)

    def _drive(self, tick: int, start: Point, target: int, stop: str, index: int) -> None:
        line = self._line
        goal = min(line.at[target], len(line.points) - 1)
        length, here = 0.0, start
        for point in line.points[self._cursor : goal + 1]:
            length += math.dist(here, point)
            here = point
        now = tick / self._rules.ticks_per_second
        until = now + length / self._rules.speed["bus"]
        self._push(BusPhase(tick, False, stop, line.names[target], start, until, now, index, self._direction))

    def _stop(self, tick: int, name: str) -> None:
        line = self._line
        index = line.names.index(name)
        self._cursor = min(line.at[index], len(line.points) - 1)
        now = tick / self._rules.ticks_per_second
        until = now + self._rules.bus_dwell
        self._push(BusPhase(tick, True, name, "", line.stops[index], until, now, index, self._direction))

    def _push(self, phase: BusPhase) -> None:
        self._phases.append(phase)
        self._ticks.append(phase.tick)


def first_tick(seconds: float, at_least: int, rate: int) -> int:
    """The first tick >= ``at_least`` whose time ``tick / rate`` is >= ``seconds`` (compared without slack)."""
    tick = max(at_least, math.ceil(seconds * rate) - 2)
    while tick / rate < seconds:
        tick += 1
    return tick
