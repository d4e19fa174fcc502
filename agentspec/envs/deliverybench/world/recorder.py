"""The recorder: what an episode is judged by.

It counts while the world runs (attempts, consumption, interruptions, idle time) and turns the counts into the report
and the evaluation figures at any moment. Sources of every figure: the benchmark's run report and its evaluator; the
headline figure is *hourly profit*, the growth of the balance per hour of the **shift** (not of active time).

Two habits of the original are kept because published figures rest on them: waiting and charging book their full planned
duration as idle when they start, and "late" allows no grace period.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from agentspec.envs.deliverybench.world.settlement import Settlement
from agentspec.envs.deliverybench.world.state import State

PREVENTIVE = ("early_charge", "early_rest", "use_energy_drink", "use_scooter_battery_pack")
INTERRUPTIONS = ("scooter_depleted", "hospital_rescue", "rent_insufficient", "charge_insufficient")
TICKS = 10.0


class Recorder:
    """Counters of one episode. ``mode_ticks`` per transport mode, ``idle`` seconds per cause, percentages consumed."""

    FIELDS = ("mode_ticks", "idle", "interruptions", "prevention", "attempts", "successes", "social")

    def __init__(self) -> None:
        self.mode_ticks: Counter[str] = Counter()
        self.idle: dict[str, float] = {}
        self.interruptions: Counter[str] = Counter()
        self.prevention: Counter[str] = Counter()
        self.attempts: Counter[str] = Counter()
        self.successes: Counter[str] = Counter()
        self.social: Counter[str] = Counter()
        self.energy_used = 0.0
        self.battery_used = 0.0
        self.parse_failures = 0
        self.hospital: list[tuple[int, float]] = []
        self.purchases: list[tuple[int, str, float]] = []
        self.charges: list[tuple[int, int, float, float, float, str]] = []
        self.rentals: list[tuple[int, int]] = []

    def be_idle(self, cause: str, seconds: float) -> None:
        """Book idle time (s) under a cause."""
        self.idle[cause] = self.idle.get(cause, 0.0) + seconds

    def dump(self) -> list[Any]:
        """The counters as JSON values (see `load`)."""
        return [
            *(dict(getattr(self, name)) for name in self.FIELDS),
            self.energy_used,
            self.battery_used,
            self.parse_failures,
            self.hospital,
            self.purchases,
            self.charges,
            self.rentals,
        ]

    @classmethod
    def load(cls, data: Sequence[Any]) -> Recorder:
        """A recorder with the counters of a `dump`."""
        recorder = cls()
        n = len(cls.FIELDS)
        for name, counts in zip(cls.FIELDS, data[:n], strict=True):
            setattr(recorder, name, dict(counts) if name == "idle" else Counter(counts))
        recorder.energy_used, recorder.battery_used, recorder.parse_failures = data[n : n + 3]
        hospital, purchases, charges, rentals = data[n + 3 :]
        recorder.hospital = [(t, fee) for t, fee in hospital]
        recorder.purchases = [(t, text, cost) for t, text, cost in purchases]
        recorder.charges = [(a, b, first, last, cost, why) for a, b, first, last, cost, why in charges]
        recorder.rentals = [(a, b) for a, b in rentals]
        return recorder


def evaluate(state: State, recorder: Recorder, hours_paid: float, initial_balance: float) -> dict[str, float | None]:
    """The evaluator's figures (None where the denominator is zero).

    Rates are shares in [0, 1], ``hourly_profit`` and ``*_per_hour`` are per hour of ``hours_paid`` (the shift; the time
    played where an episode was cut), but ``stamina_per_hour`` and ``interruptions_per_hour`` per active hour. Expenses
    leave bus fares out, as the benchmark does.
    ``time_utilisation`` can exceed 1 because orders overlap.
    """
    done = state.settlements
    active = state.tick / TICKS
    hours = active / 3600.0
    open_orders = list(state.orders.values())
    elapsed = [(state.tick - order.accepted) / TICKS for order in open_orders]
    overdue = sum(t > order.offer.limit for t, order in zip(elapsed, open_orders, strict=True))
    picks = [s.pick_score for s in done] + [order.pick_score for order in open_orders]
    busy = sum(min(s.duration, s.limit) for s in done)
    busy += sum(min(t, order.offer.limit) for t, order in zip(elapsed, open_orders, strict=True))
    prevented, interrupted = sum(recorder.prevention.values()), sum(recorder.interruptions.values())
    growth = state.balance - initial_balance
    return {
        "hourly_profit": growth / hours_paid,
        "hourly_profit_active": _ratio(growth, hours),
        "net_growth": growth,
        "base_per_hour": sum(s.base for s in done) / hours_paid,
        "bonus_per_hour": sum(s.bonus for s in done) / hours_paid,
        "expense_per_hour": -sum(v for k, v in state.ledger.items() if k not in ("orders", "bus")) / hours_paid,
        "pick_quality": _mean(picks),
        "on_time_rate": _ratio(sum(not s.late for s in done), len(done) + overdue),
        "time_utilisation": _ratio(busy, active),
        "effective_time_ratio": None if active == 0 else max(0.0, 1.0 - sum(recorder.idle.values()) / active),
        "stamina_per_hour": _ratio(recorder.energy_used / 100.0, hours),
        "interruptions_per_hour": _ratio(interrupted, hours),
        "prevention_rate": _ratio(prevented, prevented + interrupted),
        "violation_rate": _share(done, lambda s: not (s.temp_ok and s.odour_ok and s.damage_ok)),
        "mean_stars": _mean([s.stars for s in done]),
    }


def report(
    state: State, recorder: Recorder, shift_hours: float, initial_balance: float, hours_paid: float | None = None
) -> dict[str, Any]:
    """The run report: money, energy, orders, activity, interruptions, prevention, actions, calls and evaluation.

    ``hours_paid`` is what the figures per hour divide by, if that is not the shift (see `evaluate`).
    """
    per = shift_hours if hours_paid is None else hours_paid
    done, active = state.settlements, state.tick / TICKS
    expenses = {k: -state.ledger[k] for k in ("purchases", "charging", "rental", "hospital", "bus")}
    return {
        "meta": {
            "shift_hours": shift_hours,
            "active_seconds": active,
            "hours_paid": per,
            "profit_per": "hour of the shift" if hours_paid is None else "hour played",
            "ended": state.ended,
            "reason": state.reason,
        },
        "money": {
            "initial_balance": initial_balance,
            "balance": state.balance,
            "net_growth": state.balance - initial_balance,
            "orders_income": state.ledger["orders"],
            "base_wage": sum(s.base for s in done),
            "bonus": sum(s.bonus for s in done),
            "expenses": expenses,
            "details": {
                "purchases": [{"t": t / TICKS, "items": i, "cost": c} for t, i, c in recorder.purchases],
                "charging": [_charge_row(row) for row in recorder.charges],
                "rental": [{"start": a / TICKS, "end": b / TICKS} for a, b in recorder.rentals],
                "hospital": [{"t": t / TICKS, "fee": fee} for t, fee in recorder.hospital],
            },
        },
        "energy": {
            "personal_consumed_pct": recorder.energy_used,
            "battery_consumed_pct": recorder.battery_used,
            "personal_remaining_pct": state.energy,
            "battery_remaining_pct": state.scooter.battery,
        },
        "orders": _orders(state),
        "activity": {
            "active_time_ratio": _ratio(sum(s.duration for s in done), active),
            "orders_per_hour": _ratio(len(done), active / 3600.0),
            "idle_seconds": dict(recorder.idle),
            "mode_seconds": {mode: ticks / TICKS for mode, ticks in recorder.mode_ticks.items() if ticks},
        },
        "interruptions": {kind: recorder.interruptions[kind] for kind in INTERRUPTIONS},
        "prevention": {kind: recorder.prevention[kind] for kind in PREVENTIVE},
        "social": dict(recorder.social),
        "actions": {
            name: {"attempts": n, "successes": recorder.successes[name]} for name, n in recorder.attempts.items()
        },
        "calls": {"total": state.calls, "parse_failures": recorder.parse_failures},
        "evaluation": evaluate(state, recorder, per, initial_balance),
    }


def _orders(state: State) -> dict[str, Any]:
    done = state.settlements
    elapsed = {n: (state.tick - order.accepted) / TICKS for n, order in state.orders.items()}
    overdue = sum(elapsed[n] > order.offer.limit for n, order in state.orders.items())
    return {
        "completed": len(done),
        "late": sum(s.late for s in done),
        "timeouts": sum(s.late for s in done) + overdue,
        "mean_stars": _mean([s.stars for s in done]),
        "mean_food_stars": _mean([s.food_star for s in done]),
        "temp_ok_rate": _share(done, lambda s: s.temp_ok),
        "odour_ok_rate": _share(done, lambda s: s.odour_ok),
        "damage_ok_rate": _share(done, lambda s: s.damage_ok),
        "method_ok_rate": _share(done, lambda s: s.method_star == 5),
        "total_seconds": sum(s.duration for s in done),
        "open": len(elapsed),
        "open_overdue": overdue,
    }


def _charge_row(row: tuple[int, int, float, float, float, str]) -> dict[str, Any]:
    start, end, first, last, cost, why = row
    return {"start": start / TICKS, "end": end / TICKS, "pct": last - first, "cost": cost, "reason": why}


def _ratio(value: float, total: float) -> float | None:
    return value / total if total else None


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _share(done: Sequence[Settlement], test: Callable[[Settlement], bool]) -> float | None:
    return sum(test(s) for s in done) / len(done) if done else None
