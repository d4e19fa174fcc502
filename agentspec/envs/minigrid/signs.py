"""What a MiniGrid or BabyAI trajectory shows of why it failed (see `agentspec.failures`)."""

from __future__ import annotations

import json
from collections.abc import Iterator

from agentspec.envs.minigrid.view import AHEAD, HEADINGS
from agentspec.failures import Sign, in_a_row, in_vain_again, revisits
from agentspec.trajectory import Trajectory
from agentspec.types import Transition

NOTHING = ("toggled nothing", "picked up nothing", "dropped nothing")
MOVED = ("turned ", "went forward", "could not go forward")
"""How the messages of moves begin."""


def signs(trajectory: Trajectory) -> list[Sign]:
    """Signs of an episode."""
    again = in_vain_again(trajectory.transitions, _in_vain)
    return [*_moves(trajectory), *_nothing(trajectory), *again, *_locked(trajectory), *_end(trajectory)]


def _in_vain(t: Transition) -> bool:
    message = str(t.info.get("message", ""))
    return message in NOTHING or message.startswith("could not") or message.endswith("nothing changed")


def _locked(trajectory: Trajectory) -> Iterator[Sign]:
    for t in trajectory.transitions:
        message = str(t.info.get("message", ""))
        if message.startswith("toggled locked") and message.endswith("nothing changed"):
            yield Sign("understanding/knowledge/rule_unfamiliar", t.step, f"{message}: it needs the key, carried")


def _moves(trajectory: Trajectory) -> Iterator[Sign]:
    steps = trajectory.transitions
    messages = [str(t.info.get("message", "")) for t in steps]
    for i in in_a_row([message.startswith("could not go forward") for message in messages]):
        yield Sign("grounding/spatial/stuck", steps[i].step, messages[i])
    # What is seen, without what counts down, and where: the same action there a third time leads nowhere new. Far from
    # the walls of a hall all views are alike, so the view alone does not say that the agent is where it was.
    views = [{k: v for k, v in t.input.state.items() if k not in ("steps_left", "history")} for t in steps]
    seen = [json.dumps([place, view], sort_keys=True) for place, view in zip(_places(trajectory), views, strict=True)]
    for i in revisits([(there, t.action_text) for there, t in zip(seen, steps, strict=True)]):
        if messages[i].startswith(MOVED):
            yield Sign("grounding/spatial/stuck", steps[i].step, "the same move at the same place a third time or more")
    nowhere = len({*_places(trajectory)}) <= 2 and 2 * sum(map(_in_vain, steps)) < len(steps)
    if steps and steps[-1].truncated and not trajectory.metrics.get("success") and nowhere:
        yield Sign("understanding/knowledge/strategy", steps[-1].step, "moved about on two cells at most in all steps")


def _places(trajectory: Trajectory) -> list[tuple[int, int]]:
    """Where each step began, from the start: counted along, for the agent is not told."""
    x, y, places = 0, 0, []
    for t in trajectory.transitions:
        places.append((x, y))
        if t.info.get("message") == "went forward":
            dx, dy = AHEAD[HEADINGS.index(str(t.input.state["heading"]))]
            x, y = x + int(dx), y + int(dy)
    return places


def _nothing(trajectory: Trajectory) -> Iterator[Sign]:
    for t in trajectory.transitions:
        if t.info.get("message") in NOTHING:
            yield Sign("grounding/object/hallucination", t.step, f"{t.info['message']}: nothing is there")


def _end(trajectory: Trajectory) -> Iterator[Sign]:
    """How an episode ended that was lost by an action."""
    if not trajectory.transitions or trajectory.metrics.get("success"):
        return
    last = trajectory.transitions[-1]
    if not last.terminated:
        return
    message, mission = str(last.info.get("message", "")), str(last.input.state.get("mission", ""))
    if message.startswith("picked up "):
        yield Sign("grounding/object/misclassification", last.step, f"{message}, asked: {mission}")
    elif message == "said done":
        seen = any(str(thing["name"]) in mission for thing in last.input.state.get("in_view", ()))
        where = "not beside it" if seen else "what was asked for is not in view"
        yield Sign(f"grounding/{'spatial/distance' if seen else 'object/hallucination'}", last.step, f"done, {where}")
    elif message == "went forward":
        yield Sign("understanding/knowledge/rule_unfamiliar", last.step, "walked into what ends the episode")
    elif message.startswith("toggled"):
        yield Sign("understanding/knowledge/rule_unfamiliar", last.step, f"{message}, which ends the episode")
