"""What happened in one step, as a list of short names that reward functions and metrics read.

One entry per order or occurrence: "accepted", "picked_up", "bagged", "delivered" (and "on_time" or "late" with it),
"charged" (a session began), "charge_done", "rested", "bought", "used_item", "rented_car", "returned_car", "rode_bus",
"depleted", "hospital", "out_of_money".
"""

from __future__ import annotations

from dataclasses import dataclass

from agentspec.envs.deliverybench.world.engine import Outcome, World
from agentspec.types import Action

SIMPLE = {
    "REST": "rested",
    "BUY": "bought",
    "USE_ENERGY_DRINK": "used_item",
    "USE_BATTERY_PACK": "used_item",
    "USE_ICE_PACK": "used_item",
    "USE_HEAT_PACK": "used_item",
    "RENT_CAR": "rented_car",
    "RETURN_CAR": "returned_car",
    "BOARD_BUS": "rode_bus",
}
INTERRUPTED = {
    "scooter_depleted": "depleted",
    "hospital_rescue": "hospital",
    "rent_insufficient": "out_of_money",
    "charge_insufficient": "out_of_money",
}


@dataclass(frozen=True, slots=True)
class Progress:
    """The counts that events are the differences of."""

    accepted: frozenset[int]
    picked: frozenset[int]
    holding: frozenset[int]
    charging: bool
    charges: int
    interruptions: tuple[int, ...]

    @classmethod
    def of(cls, world: World) -> Progress:
        """The counts of a world now."""
        state, recorder = world.state, world.recorder
        return cls(
            accepted=frozenset(state.orders),
            picked=frozenset(n for n, order in state.orders.items() if order.picked is not None),
            holding=frozenset(n for n, order in state.orders.items() if order.pending),
            charging=state.charging is not None,
            charges=len(recorder.charges),
            interruptions=tuple(recorder.interruptions[kind] for kind in INTERRUPTED),
        )


def events_since(before: Progress, world: World, outcome: Outcome) -> list[str]:
    """The events of the step that led from `before` to the world's present state."""
    now = Progress.of(world)
    events = ["accepted"] * len(now.accepted - before.accepted)
    events += ["picked_up"] * len(now.picked - before.picked)
    delivered = {settled.order_id for settled in outcome.settlements}
    events += ["bagged"] * len(before.holding - now.holding - delivered)
    for settled in outcome.settlements:
        events += ["delivered", "late" if settled.late else "on_time"]
    if now.charging and (not before.charging or now.charges > before.charges):
        events.append("charged")
    ended = [row for row in world.recorder.charges[before.charges :] if row[-1] == "finished"]
    events += ["charge_done"] * len(ended)
    if outcome.ok and isinstance(outcome.action, Action) and outcome.action.name in SIMPLE:
        events.append(SIMPLE[outcome.action.name])
    for kind, old, new in zip(INTERRUPTED.values(), before.interruptions, now.interruptions, strict=True):
        events += [kind] * (new - old)
    return events
