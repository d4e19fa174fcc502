"""What a courier's trajectory shows of why it earned little (see `agentspec.failures`)."""

from __future__ import annotations

from collections.abc import Iterator

from agentspec.failures import Sign
from agentspec.trajectory import Trajectory

MISJUDGED = {
    "late": "delivered after the limit",
    "depleted": "the scooter's battery ran empty on the way",
    "hospital": "ran out of energy on the way",
    "out_of_money": "the money did not suffice",
}
"""Event -> what was misjudged."""

PARAMETERS = ("_BAD_", "_SYNTAX", "_NO_ID", "_UNKNOWN", "_QTY", "_NO_TARGET", "_NEED_PREFIX", "_NO_METHOD", "_COMP")
"""Parts of error codes that speak of a value; all other refusals of the world are about its rules."""

IDLE_S = 300.0
"""Simulated seconds of waiting without an order, with offers on the board, that count as idle."""


def signs(trajectory: Trajectory) -> list[Sign]:
    """Signs of a shift."""
    return [*_misjudged(trajectory), *_refused(trajectory), *_looked_again(trajectory), *_idle(trajectory)]


def _misjudged(trajectory: Trajectory) -> Iterator[Sign]:
    for t in trajectory.transitions:
        for event in dict.fromkeys(t.info.get("events", ())):
            if event in MISJUDGED:
                yield Sign("understanding/knowledge/numerical", t.step, MISJUDGED[event])


def _refused(trajectory: Trajectory) -> Iterator[Sign]:
    for t in trajectory.transitions:
        code = str(t.info.get("error_code") or "")
        if not t.info.get("invalid") or code.startswith(("PARSE", "MV_")) or not code:
            continue
        leaf = "understanding/knowledge/rule_unfamiliar"
        if any(part in f"{code}_" for part in PARAMETERS):
            leaf = "parse/action_interface/parameter"
        yield Sign(leaf, t.step, str(t.info.get("error"))[:200])


def _looked_again(trajectory: Trajectory) -> Iterator[Sign]:
    """The board read twice although nothing happened between."""
    before = ""
    for t in trajectory.transitions:
        action = str(t.info.get("native_action") or t.action_text)
        if action == before == "VIEW_ORDERS()":
            yield Sign("understanding/state_confusion/history_misunderstood", t.step, "the offers were in view already")
        before = action


def _idle(trajectory: Trajectory) -> Iterator[Sign]:
    """Waiting with nothing to do and offers to take; orders that were taken and never fetched."""
    for t in trajectory.transitions:
        state, action = t.input.state, str(t.info.get("native_action") or t.action_text)
        waited = float(t.info.get("seconds") or 0.0)
        if action.startswith("WAIT") and waited >= IDLE_S and state.get("offers") and not state.get("orders"):
            yield Sign("understanding/knowledge/strategy", t.step, f"waited {waited:.0f} s with offers open")
    if trajectory.transitions:
        last = trajectory.transitions[-1]
        for order in last.input.state.get("orders", ()):
            if not order.get("picked") and float(order.get("time_left_s") or 0.0) < 0:
                why = f"order {order.get('id')} was accepted and never fetched"
                yield Sign("understanding/knowledge/strategy", last.step, why)
