"""Short names for objects, as agents read and write them: `apple 1`, `counter top 2`."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

_HUMP = re.compile(r"(?<=[a-z])(?=[A-Z])")


def words(type_name: str) -> str:
    """An object type in words: `CounterTop` -> `counter top`."""
    return _HUMP.sub(" ", type_name).lower()


class Names:
    """Numbers the objects of each type in the order of their ids; who comes later gets the next number."""

    def __init__(self, known: Mapping[str, str] | None = None) -> None:
        self._name: dict[str, str] = dict(known or {})
        self._id = {name: object_id for object_id, name in self._name.items()}

    def add(self, objects: Iterable[Mapping[str, Any]]) -> None:
        """Name the objects (metadata) that have no name yet."""
        for one in sorted(objects, key=lambda o: str(o["objectId"])):
            if one["objectId"] not in self._name:
                base = words(one["objectType"])
                number = 1 + sum(1 for name in self._id if name.rpartition(" ")[0] == base)
                self._name[one["objectId"]] = f"{base} {number}"
                self._id[f"{base} {number}"] = one["objectId"]

    def name(self, object_id: str) -> str:
        """The short name of an object."""
        return self._name.get(object_id, object_id)

    def id(self, text: str) -> str:
        """The id that a short name, an id, or the only object of a type means; the text itself if none."""
        plain = " ".join(text.strip().strip("\"'").lower().split())
        if plain in self._id:
            return self._id[plain]
        same = [i for i, name in self._name.items() if name.rpartition(" ")[0] == plain]
        return same[0] if len(same) == 1 else text.strip()

    def data(self) -> dict[str, str]:
        """Id -> name, for snapshots."""
        return dict(self._name)


def whereabouts(thing: Mapping[str, Any], agent: Mapping[str, Any]) -> tuple[float, int]:
    """Metres to the nearest point of an object's box, horizontally, and degrees to its middle (right is positive)."""
    box, at = thing["axisAlignedBoundingBox"], agent["position"]
    dx, dz = box["center"]["x"] - at["x"], box["center"]["z"] - at["z"]
    gap_x = max(abs(dx) - box["size"]["x"] / 2, 0.0)
    gap_z = max(abs(dz) - box["size"]["z"] / 2, 0.0)
    bearing = math.degrees(math.atan2(dx, dz)) - agent["rotation"]["y"]
    return math.hypot(gap_x, gap_z), round((bearing + 180) % 360 - 180)


def direction(bearing: int) -> str:
    """A bearing in words."""
    if abs(bearing) <= 10:
        return "ahead"
    return f"{abs(bearing)} deg {'right' if bearing > 0 else 'left'}"
