"""Players that fail in known ways, and honest ones: who plays the labelled sample of failures (`failure_sample`).

A player is a function of what it sees (`Seat`) that gives the next text. Most do the honest player's bidding and err
now and then, as models do: `sometimes(share, fault)` takes the fault at a share of the steps.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from agentspec.envs.experts import Player, player
from agentspec.types import Task


@dataclass
class Seat:
    """What a player knows: the environment's report, what it did, and the honest player to ask."""

    honest: Player
    rng: random.Random
    text: str = ""
    info: Mapping[str, Any] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)

    @property
    def state(self) -> Mapping[str, Any]:
        """The environment's structured state."""
        return self.info["state"]  # type: ignore[no-any-return]

    @property
    def menu(self) -> tuple[str, ...]:
        """The choices, in menu mode."""
        return self.info["action_schema"].choices  # type: ignore[no-any-return]

    def advice(self) -> str:
        """What the honest player does."""
        return self.honest.act(self.info)


Act = Callable[[Seat], str]


def seat(task: Task, seed: int, role: str = "rule_based") -> Seat:
    """A seat at one task; `seed` of everything that is drawn."""
    rng = random.Random(seed)
    return Seat(player(task.env, role, task.options, rng), rng)


def honest(at: Seat) -> str:
    """Plays as well as its rules."""
    return at.advice()


def always(*texts: str) -> Act:
    """The texts in a circle."""
    return lambda at: texts[len(at.said) % len(texts)]


def sometimes(share: float, *faults: str | Act) -> Act:
    """At a share of the steps one of the faults, else what the honest player does."""

    def act(at: Seat) -> str:
        advice = at.advice()
        if at.rng.random() >= share:
            return advice
        fault = at.rng.choice(faults)
        return fault if isinstance(fault, str) else fault(at)

    return act


def at_steps(faults: Mapping[int, str | Act]) -> Act:
    """The honest player, but for these steps."""

    def act(at: Seat) -> str:
        advice, fault = at.advice(), faults.get(len(at.said))
        return advice if fault is None else fault if isinstance(fault, str) else fault(at)

    return act


def first_then(texts: Iterator[str] | tuple[str, ...], rest: Act) -> Act:
    """The texts first."""
    opening = tuple(texts)
    return lambda at: opening[len(at.said)] if len(at.said) < len(opening) else rest(at)


def copies(at: Seat) -> str:
    """Writes the observation in place of an action."""
    return " ".join(at.text.split())[:260]


def again(at: Seat) -> str:
    """Whatever it said last."""
    return at.said[-1] if at.said else at.advice()


def prefers(*words: str) -> Act:
    """The first choice of the menu that begins with one of the words, in their order; else the first."""
    return lambda at: next((c for w in words for c in at.menu if c.startswith(w)), at.menu[0])


def any_of(*texts: str) -> Act:
    """One of the texts at random."""
    return lambda at: at.rng.choice(texts)


# -- couriers --------------------------------------------------------------------------------------


def _orders(at: Seat, picked: bool) -> list[Any]:
    return [o["id"] for o in at.state["orders"] if bool(o.get("picked")) == picked]


def fetches_from_afar(at: Seat) -> str:
    """Takes food where the restaurant is not."""
    return f"PICKUP(orders={_orders(at, False)[:1]})" if _orders(at, False) else "ACCEPT_ORDER(99)"


def hands_over_anywhere(at: Seat) -> str:
    """Delivers where the customer is not."""
    waiting = _orders(at, True) or _orders(at, False)
    return f'DROP_OFF(oid={waiting[0]}, method="leave_at_door")' if waiting else "VIEW_BAG()"


def dawdles(at: Seat) -> str:
    """Waits ten minutes once it carries something; honest else."""
    advice = at.advice()
    late = _orders(at, True) and sum(text == "WAIT(600)" for text in at.said) < 2
    return "WAIT(600)" if late else advice


def never_charges(at: Seat) -> str:
    """Drives between two far corners, whatever the battery says."""
    ends = ("MOVE(161.7m, 412.0m)", "MOVE(-24.2m, 68.8m)")
    return ends[len(at.said) % 2]


def hoards(at: Seat) -> str:
    """Accepts the first offers and then waits."""
    offers = [o["id"] for o in at.state["offers"]]
    if not at.said:
        return "VIEW_ORDERS()"
    return f"ACCEPT_ORDER({offers[:3]})" if len(at.said) == 1 and offers else "WAIT(240)"


def strolls(at: Seat) -> str:
    """Walks about and looks."""
    return f"MOVE({at.rng.randrange(-20, 220)}.0m, {at.rng.randrange(20, 420)}.0m)"


# -- grids and rooms -------------------------------------------------------------------------------


def grabs(at: Seat) -> str:
    """Takes whatever is in front; else walks about."""
    if "pickup" in str(at.state.get("affordances")) or "key" in at.state["in_front"] or "ball" in at.state["in_front"]:
        return "PICK_UP()"
    if "box" in at.state["in_front"]:
        return "PICK_UP()"
    return at.rng.choice(("FORWARD()", "FORWARD()", "TURN_LEFT()", "TURN_RIGHT()"))


def into_lava(at: Seat) -> str:
    """Straight ahead into lava once it is in front; turns to find it."""
    return "FORWARD()" if at.state["in_front"] in ("lava", "nothing", "") else "TURN_RIGHT()"


def takes_anything(at: Seat) -> str:
    """In a room by menu: takes the first thing, puts it down, goes elsewhere."""
    return next((c for w in ("take", "put") for c in at.menu if c.startswith(w)), at.rng.choice(at.menu[:-1]))


def stops_in_sight(at: Seat) -> str:
    """Stops as soon as anything is in view."""
    advice = at.advice()
    return "STOP()" if at.state["visible"] else "MOVE_AHEAD()" if advice == "STOP()" else advice
