"""What a MiniGrid or BabyAI trajectory shows of why it failed (see `agentspec.failures`)."""

from __future__ import annotations

import json
from collections.abc import Iterator

from agentspec.envs.minigrid.view import AHEAD, HEADINGS
from agentspec.failures import Sign, in_a_row, revisits
from agentspec.trajectory import Trajectory

NOTHING = ("toggled nothing", "picked up nothing", "dropped nothing")


def signs(trajectory: Trajectory) -> list[Sign]:
    """Signs of an episode."""
    return [*_moves(trajectory), *_nothing(trajectory), *_end(trajectory)]


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
        yield Sign("grounding/spatial/stuck", steps[i].step, "the same action at the same place a third time or more")


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
