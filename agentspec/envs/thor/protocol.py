"""What a player of a household world owes: `step(action) -> Event`, in ai2thor's words.

An action is a mapping with `action` (its name) and that action's fields (`objectId`, `moveMagnitude`, ...). Metadata is
JSON data with ai2thor's names: `agent` (position, rotation, cameraHorizon), `objects` (objectId, visible, distance,
isOpen, ...), `inventoryObjects`, `lastAction`, `lastActionSuccess`, `errorMessage`, `actionReturn`. What cannot be done
sets `lastActionSuccess` to False and says why in `errorMessage`; a player never raises for an action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from agentspec.envs.thor.engine import OfflineThor

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Event:
    """What follows an action: metadata, and the picture the agent sees (drawn when it is first asked for).

    Args:
        metadata: JSON data with ai2thor's field names; treat it as read-only.
        draw: makes the picture, uint8 (height, width, 3); None where the player has none.
    """

    metadata: Mapping[str, Any]
    draw: Callable[[], Picture] | None = field(default=None, repr=False, compare=False)

    @property
    def frame(self) -> Picture | None:
        """The egocentric picture, uint8 (height, width, 3), or None."""
        return None if self.draw is None else self.draw()

    @property
    def success(self) -> bool:
        """Whether the last action was carried out."""
        return bool(self.metadata["lastActionSuccess"])

    @property
    def error(self) -> str:
        """Why not; empty after a success."""
        return str(self.metadata["errorMessage"])

    def thing(self, object_id: str) -> Mapping[str, Any] | None:
        """The metadata of one object, or None if there is none of this id."""
        return next((o for o in self.metadata["objects"] if o["objectId"] == object_id), None)


class Refused(Exception):  # noqa: N818  (a message to the agent, not a fault)
    """An action that cannot be carried out; its text is the `errorMessage`. Players raise and catch it inside."""


class Thor(Protocol):
    """A player of household worlds."""

    def step(self, action: Mapping[str, Any]) -> Event:
        """Carry out one action; never raises for what an action asks."""
        ...

    def observe(self) -> Event:
        """The event of the last step, without acting."""
        ...

    def boxes(self) -> OfflineThor:
        """The present state as a world of boxes, to plan ways in; acting in it is nobody's business."""
        ...

    def distance(self, target: str) -> float | None:
        """Metres on foot to where an object of this type or id is seen; None if no way is known."""
        ...

    def snapshot(self) -> bytes:
        """The exact state."""
        ...

    def restore(self, blob: bytes) -> Event:
        """Go back to a `snapshot` of the same scene."""
        ...

    def close(self) -> None:
        """Let go of what the player holds."""
        ...
