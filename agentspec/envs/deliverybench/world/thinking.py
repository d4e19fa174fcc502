"""What thinking costs: nothing, or seconds of the shift.

The clock of the original goes on while the model thinks, so its results mix how well an agent decides with how fast the
hardware answers. Here thinking is free by default, and where slow agents are to pay for it the price is in simulated
seconds per model call and per token written: numbers of the agent, not of the machine it ran on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

PAUSED = "paused"
KEYS = ("call", "token")


@dataclass(frozen=True, slots=True)
class ThinkTime:
    """Simulated seconds charged per model call and per token the model wrote."""

    call: float = 0.0
    token: float = 0.0

    @classmethod
    def of(cls, value: str | Mapping[str, float] | ThinkTime) -> ThinkTime:
        """From "paused" or a mapping such as {"call": 2.0, "token": 0.02}.

        Raises:
            ValueError: anything else, or a price that is negative or no number.
        """
        if isinstance(value, ThinkTime):
            return value
        if value == PAUSED:
            return cls()
        if not isinstance(value, Mapping) or not value or not set(value) <= set(KEYS):
            raise ValueError(
                f'think_time is {value!r}; expected "paused" or seconds such as {{"call": 2, "token": 0.02}}'
            )
        for key, price in value.items():
            number = isinstance(price, (int, float)) and not isinstance(price, bool)
            if not (number and math.isfinite(price) and price >= 0.0):
                raise ValueError(f"think_time {key!r} is {price!r}; expected seconds, 0 or more")
        return cls(**{key: float(price) for key, price in value.items()})

    def seconds(self, calls: int, tokens: int) -> float:
        """The price of one decision."""
        return self.call * calls + self.token * tokens
