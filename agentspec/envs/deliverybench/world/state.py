"""What a delivery world is at one moment: plain mutable data, no logic.

`World.state` is a `State`. Everything a courier could see (and the observation text, the menu and the picture are
built from) is here, as data and not as text. Times are **ticks** of 0.1 s unless a name ends in `_seconds`; positions
are centimetres; energy and battery run from 0 to 100 %; money is dollars.

Food temperatures change while nobody looks: call `state.bag.advance(state.tick)` (`World.look` does) before
reading them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from agentspec.envs.deliverybench.world.bag import Bag, Item
from agentspec.envs.deliverybench.world.orders import Offer
from agentspec.envs.deliverybench.world.settlement import Settlement

Point = tuple[float, float]

USABLE, DEPLETED, PARKED = "usable", "depleted", "parked"
LEDGER_KINDS = ("orders", "purchases", "charging", "rental", "hospital", "bus")


@dataclass(slots=True)
class Scooter:
    """The courier's own e-scooter: `state` is usable, depleted or parked; `park` (cm) only while parked."""

    battery: float
    state: str = USABLE
    park: Point | None = None


@dataclass(slots=True)
class Car:
    """A rented car: `state` is usable (driven) or parked; billed from `since` until it is returned."""

    since: int
    state: str = USABLE
    park: Point | None = None


@dataclass(slots=True)
class Charging:
    """A running session: started at tick `since` and `first` %, goes on to `target` %; `cost` so far."""

    since: int
    first: float
    target: float
    cost: float = 0.0


@dataclass(slots=True)
class OrderState:
    """An accepted, undelivered order. `pending` are the items still in the hand (a subset of `items`)."""

    offer: Offer
    accepted: int
    pick_score: float
    picked: int | None = None
    items: list[Item] = field(default_factory=list)
    pending: list[Item] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Notice:
    """Something the courier is told once: a kind ("orders", "bag", "schedule", "bagging", "charging", "depleted",
    "hospital", "rental", "settled"), our text for it, and the facts behind the text."""

    kind: str
    text: str
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class HelpRequest:
    """An own request on the board for help: `kind`, `bounty` (dollars), lifetime in seconds (None: no end)."""

    id: int
    kind: str
    bounty: float = 0.0
    seconds: float | None = None


@dataclass(slots=True)
class State:
    """The complete state of one world; see the module docstring for units.

    `ledger` holds signed totals per kind of entry and always adds up to `balance - initial_balance`. `orders` are
    the accepted, undelivered orders by id; `settlements` the delivered ones in order of delivery. `pool` lists the
    ids on offer and `next_order` the id that will be drawn next. `recent` are the last five successful actions,
    oldest first; `error` is the last failure until something succeeds; `notices` last until the next action that
    clears them; `requests` are the own ones on the board for help. `hospital_until` is the tick of release;
    `interrupt_at` the tick at which a pending interruption strikes; `hands_at` the tick up to which food in hand
    has cooled. `reason` is "" until the episode ends.
    """

    position: Point
    energy: float
    balance: float
    scooter: Scooter
    bag: Bag
    pool: list[int]
    next_order: int
    tick: int = 0
    yaw: float = 0.0
    mode: str = "e-scooter"
    pace: str = "normal"
    ledger: dict[str, float] = field(default_factory=lambda: dict.fromkeys(LEDGER_KINDS, 0.0))
    car: Car | None = None
    charging: Charging | None = None
    orders: dict[int, OrderState] = field(default_factory=dict)
    settlements: list[Settlement] = field(default_factory=list)
    inventory: dict[str, int] = field(default_factory=dict)
    recent: list[str] = field(default_factory=list)
    error: str = ""
    requests: list[HelpRequest] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)
    calls: int = 0
    parse_errors: int = 0
    hospital_until: int | None = None
    interrupt_at: int | None = None
    riding_to: str = ""
    hands_at: int = 0
    reason: str = ""

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return bool(self.reason)

    @property
    def carrying(self) -> list[int]:
        """Ids of the orders picked up and not yet delivered."""
        return [number for number, order in self.orders.items() if order.picked is not None]
