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
"""Parts of error codes that speak of a value."""
NO_SUCH = ("ACC_NONE", "PU_NO_ORDERS")
"""Codes of ids that do not exist."""
ELSEWHERE = ("DO_NOT_AT_DOOR", "DO_NOT_AT_CUSTOMER")
"""Codes of the right act at the wrong place; all other refusals of the world are about its rules."""

IDLE_S = 300.0
"""Simulated seconds on end of waiting without an order, with offers on the board, that count as idle."""
MORE = "more choices"


def signs(trajectory: Trajectory) -> list[Sign]:
    """Signs of a shift."""
    own = (_misjudged, _refused, _looked_again, _idle, _undelivered)
    return [sign for rule in own for sign in rule(trajectory)]


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
        yield Sign(_leaf(code, str(t.info.get("error"))), t.step, str(t.info.get("error"))[:200])


def _leaf(code: str, error: str) -> str:
    """What a refusal speaks of. `PU_NOTHING` gives a reason per order: picked up already, elsewhere, or not ready."""
    if code in NO_SUCH or any(part in f"{code}_" for part in PARAMETERS):
        return "parse/action_interface/parameter"
    if code == "PU_NOTHING" and " already" in error:
        return "understanding/state_confusion/history_misunderstood"
    if code in ELSEWHERE or (code == "PU_NOTHING" and error.endswith(" away")):
        return "grounding/spatial/distance"
    return "understanding/knowledge/rule_unfamiliar"


def _looked_again(trajectory: Trajectory) -> Iterator[Sign]:
    """The board read twice although nothing happened between; a menu's pages turned until they come again."""
    before, pages = "", set[tuple[str, ...]]()
    for t in trajectory.transitions:
        action = str(t.info.get("native_action") or t.action_text)
        if action == before == "VIEW_ORDERS()":
            yield Sign("understanding/state_confusion/history_misunderstood", t.step, "the offers were in view already")
        choices = t.input.action_schema.choices
        if choices and action == MORE and choices in pages:
            why = "these choices were shown since anything was done"
            yield Sign("understanding/state_confusion/history_misunderstood", t.step, why)
        pages = pages | {choices} if action == MORE else set()
        before = action


def _idle(trajectory: Trajectory) -> Iterator[Sign]:
    """Waiting with nothing to do and offers to take."""
    waited = 0.0
    for t in trajectory.transitions:
        state, action = t.input.state, str(t.info.get("native_action") or t.action_text)
        idle = action.startswith("WAIT") and state.get("offers") and not state.get("orders")
        waited = waited + float(t.info.get("seconds") or 0.0) if idle else 0.0
        if waited >= IDLE_S:
            yield Sign("understanding/knowledge/strategy", t.step, f"waited {waited:.0f} s with offers open")


def _undelivered(trajectory: Trajectory) -> Iterator[Sign]:
    """What an end without a delivery says of plan and judgement."""
    if not trajectory.transitions:
        return
    last, events = trajectory.transitions[-1], [e for t in trajectory.transitions for e in t.info.get("events", ())]
    for order in last.input.state.get("orders", ()):
        if float(order.get("time_left_s") or 0.0) < 0:
            why = f"order {order.get('id')} was accepted and its time ran out"
            yield Sign("understanding/knowledge/numerical", last.step, why)
            if not order.get("picked"):
                yield Sign("understanding/knowledge/strategy", last.step, f"{why} before it was fetched")
    if (last.terminated or last.truncated) and "picked_up" not in events and last.input.state.get("offers"):
        yield Sign("understanding/knowledge/strategy", last.step, "nothing was fetched in all steps")
