"""What a household trajectory shows of why it failed (see `agentspec.failures`): ALFRED and RoboTHOR."""

from __future__ import annotations

import re
from collections.abc import Iterator

from agentspec.failures import Sign, in_a_row, revisits
from agentspec.trajectory import Trajectory
from agentspec.types import Transition

BLOCKED = "blocks the way"


def alfred(trajectory: Trajectory) -> list[Sign]:
    """Signs of an ALFRED episode."""
    return [*_blocked(trajectory), *_refused(trajectory), *_wrong_object(trajectory), *_no_plan(trajectory)]


def robothor(trajectory: Trajectory) -> list[Sign]:
    """Signs of a RoboTHOR episode."""
    return [*_blocked(trajectory), *_circles(trajectory), *_stop(trajectory)]


def _said(t: Transition) -> str:
    return f"{t.info.get('message') or ''} {t.info.get('error') or ''}".strip()


def _blocked(trajectory: Trajectory) -> Iterator[Sign]:
    steps = trajectory.transitions
    for i in in_a_row([BLOCKED in _said(t) for t in steps]):
        yield Sign("grounding/spatial/stuck", steps[i].step, _said(steps[i]))


def _circles(trajectory: Trajectory) -> Iterator[Sign]:
    """The same pose and the same action for the third time."""
    steps = trajectory.transitions
    poses = [tuple(t.input.state.get(k) for k in ("x", "z", "yaw", "horizon")) for t in steps]
    for i in revisits([(pose, t.action_text) for pose, t in zip(poses, steps, strict=True)]):
        yield Sign(
            "grounding/spatial/stuck", steps[i].step, "the same action at the same place for the third time or more"
        )


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
        if picked and not t.info.get("invalid") and picked[1] not in wanted and picked[1].split()[-1] not in wanted:
            yield Sign(
                "grounding/object/misclassification", t.step, f"picked up {picked[1]}, which the task does not name"
            )


def _no_plan(trajectory: Trajectory) -> Iterator[Sign]:
    """All steps used without a single condition of the goal."""
    last = trajectory.transitions[-1] if trajectory.transitions else None
    if last is not None and last.truncated and not trajectory.metrics.get("goal_conditions_met"):
        yield Sign("understanding/knowledge/strategy", last.step, "no condition of the goal was met in all steps")
