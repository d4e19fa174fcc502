"""What a household trajectory shows of why it failed (see `agentspec.failures`): ALFRED and RoboTHOR."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator

from agentspec.failures import Sign, in_a_row, in_vain_again, revisits
from agentspec.trajectory import Trajectory
from agentspec.types import Transition

BLOCKED = "blocks the way"


def alfred(trajectory: Trajectory) -> list[Sign]:
    """Signs of an ALFRED episode."""
    own = (_refused(trajectory), _wrong_object(trajectory), _no_plan(trajectory))
    return [*_blocked(trajectory), *_circles(trajectory, _view), *itertools.chain(*own)]


def robothor(trajectory: Trajectory) -> list[Sign]:
    """Signs of a RoboTHOR episode."""
    again = in_vain_again(trajectory.transitions, lambda t: _said(t).startswith("could not"))
    return [*_blocked(trajectory), *_circles(trajectory, _pose), *again, *_nowhere(trajectory), *_stop(trajectory)]


def _said(t: Transition) -> str:
    return f"{t.info.get('message') or ''} {t.info.get('error') or ''}".strip()


def _blocked(trajectory: Trajectory) -> Iterator[Sign]:
    steps = trajectory.transitions
    for i in in_a_row([BLOCKED in _said(t) for t in steps]):
        yield Sign("grounding/spatial/stuck", steps[i].step, _said(steps[i]))


def _pose(t: Transition) -> object:
    return tuple(t.input.state.get(k) for k in ("x", "z", "yaw", "horizon"))


def _view(t: Transition) -> object:
    """What is in view, from how far, and what is held: a place, where places are not told; none where nothing is."""
    state = t.input.state
    seen = [(thing.get("name"), thing.get("distance"), thing.get("bearing")) for thing in state.get("visible", ())]
    return (state.get("facing"), state.get("horizon"), state.get("holding"), *seen) if seen else None


def _circles(trajectory: Trajectory, place: Callable[[Transition], object]) -> Iterator[Sign]:
    """What is not refused, done at the same place for the third time."""
    steps = [t for t in trajectory.transitions if not t.info.get("invalid") and place(t) is not None]
    for i in revisits([(place(t), t.action_text) for t in steps]):
        yield Sign(
            "grounding/spatial/stuck", steps[i].step, "the same action at the same place for the third time or more"
        )


def _nowhere(trajectory: Trajectory) -> Iterator[Sign]:
    """All steps used on two places at most, by moves that were possible."""
    steps = trajectory.transitions
    if not steps or not steps[-1].truncated or trajectory.metrics.get("success"):
        return
    places = {(t.input.state.get("x"), t.input.state.get("z")) for t in steps}
    if len(places) <= 2 and 2 * sum(_failed(t) for t in steps) < len(steps):
        yield Sign("understanding/knowledge/strategy", steps[-1].step, "went nowhere in all steps")


def _failed(t: Transition) -> bool:
    return bool(t.info.get("invalid")) or _said(t).startswith("could not") or BLOCKED in _said(t)


def _stop(trajectory: Trajectory) -> Iterator[Sign]:
    last = trajectory.transitions[-1] if trajectory.transitions else None
    if last is None or not last.terminated or trajectory.metrics.get("success"):
        return
    target = re.sub(r"\W", "", str(last.input.state.get("target", ""))).lower()
    seen = [re.sub(r"[\W\d]", "", str(thing.get("name", ""))).lower() for thing in last.input.state.get("visible", ())]
    if target in seen:
        yield Sign("grounding/spatial/distance", last.step, "stopped with the target in view and out of reach")
    else:
        yield Sign("grounding/object/hallucination", last.step, "stopped although the target is not in view")


def _refused(trajectory: Trajectory) -> Iterator[Sign]:
    for t in trajectory.transitions:
        error = str(t.info.get("error") or "")
        if not t.info.get("invalid") or not error or BLOCKED in error or t.info.get("error_code") != "failed":
            continue
        named = re.search(r'"([^"]+)"', t.action_text)
        seen = {str(thing.get("name")) for thing in t.input.state.get("visible", ())}
        if "not visible" in error or "no object" in error:
            near = named is not None and named[1] in seen
            yield Sign(f"grounding/{'spatial/distance' if near else 'object/hallucination'}", t.step, error[:200])
        elif "already" in error or "hand" in error:
            yield Sign("understanding/state_confusion/history_misunderstood", t.step, error[:200])
        else:
            yield Sign("understanding/knowledge/rule_unfamiliar", t.step, error[:200])


def _wrong_object(trajectory: Trajectory) -> Iterator[Sign]:
    """Picked up what the task does not speak of."""
    for t in trajectory.transitions:
        picked = re.match(r'(?:PICKUP\("|take )([a-z ]+?)(?: \d+)?(?:"\)|$)', t.action_text)
        if picked and picked[1].endswith("knife"):
            continue  # what is to be sliced needs one, and tasks seldom say so
        wanted = str(t.input.state.get("task") or t.input.instruction).lower()
        kind = picked[1].removesuffix(" sliced") if picked else ""
        if kind and not t.info.get("invalid") and kind not in wanted and kind.split()[-1] not in wanted:
            yield Sign("grounding/object/misclassification", t.step, f"picked up {kind}, which the task does not name")


def _no_plan(trajectory: Trajectory) -> Iterator[Sign]:
    """All steps used, most of them on what was possible, without a single condition of the goal."""
    steps = trajectory.transitions
    last = steps[-1] if steps and 2 * sum(map(_failed, steps)) < len(steps) else None
    if last is not None and last.truncated and not trajectory.metrics.get("goal_conditions_met"):
        yield Sign("understanding/knowledge/strategy", last.step, "no condition of the goal was met in all steps")
