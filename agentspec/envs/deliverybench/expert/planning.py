"""Which orders to take and in which sequence to serve them: an insertion heuristic for the courier's round.

A round is a sequence of stops, each the pick-up or the drop-off of one order. Its worth is what the deliveries pay, by
the settlement's own rules for lateness, less the value of the time and the ways it takes. A new order is worth taking
if the round with its two stops inserted at their best places is worth more than the round without. The value of a
second is what a good courier earns in one, so a poor order is left for a better one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

Point = tuple[float, float]
Metres = Callable[[Point, Point], float]
Progress = tuple[Point, float, float, float, float, int]
"""Place, seconds from now, metres, idle seconds, income and actions so far."""

PICKUP, DROPOFF = "pickup", "dropoff"
GRACE_S = 60.0
LATE_FLOOR = 0.5
PATIENCE = 3


@dataclass(frozen=True, slots=True)
class Job:
    """One order as planning sees it. Times in s from now, pay in dollars, places in metres.

    `ready` is when its food can be taken (0 if ready), `elapsed` the age of an accepted order, `limit` its whole time
    limit; `picked` orders have only their drop-off left.
    """

    id: int
    pickup: Point
    dropoff: Point
    pay: float
    limit: float
    ready: float = 0.0
    elapsed: float = 0.0
    picked: bool = False


@dataclass(frozen=True, slots=True)
class Stop:
    """A pick-up or drop-off of a round."""

    job: int
    kind: str
    place: Point


@dataclass(frozen=True, slots=True)
class Worth:
    """What a round brings: its `value` (dollars, time and way deducted), duration (s), way (m) and income (dollars)."""

    value: float
    seconds: float
    metres: float
    income: float


@dataclass
class Planner:
    """Judges and improves rounds.

    Attributes:
        metres: way between two places (m) in the vehicle in use.
        speed: m/s.
        second: value of a second under way (dollars).
        idle: value of a second of waiting for food (dollars); less, because later orders may fill it.
        metre: cost of a metre (dollars): battery, energy.
        call: cost of an action (dollars), where the number of actions is limited: one per stop, one per way.
        stop: seconds lost at each stop.
        delay: seconds until the round can begin.
        horizon: seconds until the shift ends; what is delivered later pays nothing.
        actions: actions that may still be taken; what is delivered after them pays nothing.
        per_pickup: actions of a pick-up (2 with packing the bag).
        per_offer: actions to accept one more offer (0 when one action accepts any number).
    """

    metres: Metres
    speed: float
    second: float
    metre: float
    idle: float = 0.0
    call: float = 0.0
    stop: float = 4.0
    delay: float = 0.0
    horizon: float = float("inf")
    actions: float = float("inf")
    per_pickup: int = 2
    per_offer: int = 0
    jobs: dict[int, Job] = field(default_factory=dict)

    def worth(self, start: Point, stops: Sequence[Stop], spent: int = 0) -> Worth:
        """The worth of driving `stops` in order, starting now at `start`, after `spent` other actions."""
        return self._worth(self._drive(self._begin(start, spent), stops))

    def insert(self, start: Point, stops: Sequence[Stop], job: Job, spent: int = 0) -> tuple[Worth, list[Stop]]:
        """The best round with the stops of `job` added, the others keeping their sequence."""
        self.jobs[job.id] = job
        drop = Stop(job.id, DROPOFF, job.dropoff)
        pick = [] if job.picked else [Stop(job.id, PICKUP, job.pickup)]
        before = self._begin(start, spent)
        most, best, at = -math.inf, before, (0, 0)
        for i in range(len(stops) + 1):
            # Candidates with the pick-up at i share the way up to it, and each next one the way up to its drop-off.
            now = self._drive(before, pick)
            for j in range(i, len(stops) + 1):
                end = self._drive(now, (drop, *stops[j:]))
                value = self._value(end)
                if value > most:
                    most, best, at = value, end, (i, j)
                if not pick or j == len(stops):
                    break
                now = self._drive(now, stops[j : j + 1])
            before = self._drive(before, stops[i : i + 1])
        i, j = at
        return self._worth(best), [*stops[:i], *pick, *stops[i:j], drop, *stops[j:]]

    def _begin(self, start: Point, spent: int) -> Progress:
        return (start, self.delay, 0.0, 0.0, 0.0, spent)

    def _drive(self, progress: Progress, stops: Sequence[Stop]) -> Progress:
        """Where the courier is after `stops`, with the totals so far."""
        here, now, way, idle, income, actions = progress
        for stop in stops:
            if stop.place != here:
                leg = self.metres(here, stop.place)
                way += leg
                now += leg / self.speed + self.stop
                actions += 1
                here = stop.place
            job = self.jobs[stop.job]
            if stop.kind == PICKUP:
                actions += self.per_pickup
                if job.ready > now:
                    idle += job.ready - now
                    now = job.ready
                continue
            actions += 1
            if now <= self.horizon and actions <= self.actions:
                income += payment(job.pay, job.elapsed + now, job.limit)
        return here, now, way, idle, income, actions

    def _value(self, progress: Progress) -> float:
        _, now, way, idle, income, actions = progress
        time = self.second * (now - idle) + self.idle * idle
        return income - time - self.metre * way - self.call * actions

    def _worth(self, progress: Progress) -> Worth:
        _, now, way, _, income, _ = progress
        return Worth(self._value(progress), now, way, income)

    def improve(self, start: Point, stops: Sequence[Stop], rounds: int = 2) -> tuple[Worth, list[Stop]]:
        """Take each order out and put it back at its best place until nothing gains, at most `rounds` times."""
        current, best = list(stops), self.worth(start, stops)
        for _ in range(rounds):
            changed = False
            for number in dict.fromkeys(stop.job for stop in current):
                rest = [stop for stop in current if stop.job != number]
                worth, candidate = self.insert(start, rest, self.jobs[number])
                if worth.value > best.value + 1e-6:
                    current, best, changed = candidate, worth, True
            if not changed:
                break
        return best, current

    def build(self, start: Point, jobs: Iterable[Job], known: Sequence[Stop] = ()) -> tuple[Worth, list[Stop]]:
        """A round over `jobs`, beginning from the sequence `known` (stops of other orders are dropped)."""
        wanted = {job.id: job for job in jobs}
        self.jobs.update(wanted)
        stops = [s for s in known if s.job in wanted and not (s.kind == PICKUP and wanted[s.job].picked)]
        stops = [Stop(s.job, s.kind, _place(wanted[s.job], s.kind)) for s in stops]
        present = {(s.job, s.kind) for s in stops}
        for job in wanted.values():
            needed = {(job.id, DROPOFF)} if job.picked else {(job.id, PICKUP), (job.id, DROPOFF)}
            if not needed <= present:
                stops = [s for s in stops if s.job != job.id]
                stops = self.insert(start, stops, job)[1]
        return self.improve(start, stops)

    def choose(
        self, start: Point, stops: Sequence[Stop], offers: Iterable[Job], room: int, margin: float
    ) -> tuple[list[int], list[Stop]]:
        """Take the offers that raise the worth of the round by `margin` each or more, at most `room` of them.

        Orders make each other worthwhile: two on one way may pay where neither does alone. So up to `PATIENCE` offers
        are added on trial before the search gives up.

        Returns:
            ids to accept, in order of choice, and the round that serves them.
        """
        current, left = list(stops), list(offers)
        accepted: list[int] = []
        best = self.worth(start, current).value
        kept, plan = 0, current
        while left and len(accepted) < room and len(accepted) < kept + PATIENCE:
            spent = 1 + self.per_offer * len(accepted)
            trials = [(self.insert(start, current, job, spent), job) for job in left]
            (worth, current), job = max(trials, key=lambda trial: (trial[0][0].value, -trial[1].id))
            accepted.append(job.id)
            left.remove(job)
            if worth.value >= best + margin * (len(accepted) - kept):
                best, kept, plan = worth.value, len(accepted), current
        return accepted[:kept], plan


def payment(pay: float, elapsed: float, limit: float) -> float:
    """Wage and bonus of a delivery with good food and the right hand-over, by its lateness (benchmark settlement)."""
    base = pay if elapsed <= limit + GRACE_S else pay * max(LATE_FLOOR, limit / elapsed)
    ratio = elapsed / limit
    if ratio <= 1.0:
        return base + 3.0
    return base + (1.5 if ratio <= 1.25 else 0.0)


def _place(job: Job, kind: str) -> Point:
    return job.pickup if kind == PICKUP else job.dropoff
