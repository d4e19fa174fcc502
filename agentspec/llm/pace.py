"""Whether those who act are worth waiting for, before the model goes on without them.

A forward of the model costs nearly the same with one more row in it, so a row that comes a moment too late costs a
forward of its own. Waiting pays when episodes usually come back well within the time a forward takes, and only then.
"""

from __future__ import annotations

import time

_SHARE = 0.5
_WEIGHT = 0.2


class Pace:
    """Moving averages of how long a step of the work lasts, and an episode is away between an answer and its next
    request.
    """

    def __init__(self) -> None:
        self.step_s = 0.05
        self.away_s = 0.0
        self._left: dict[str, float] = {}

    @property
    def grace_s(self) -> float:
        """Seconds to wait for the next to come back: half a step, or none if they usually take longer."""
        longest = _SHARE * self.step_s
        return longest if self.away_s < longest else 0.0

    def worked(self, seconds: float) -> None:
        """A step took so long."""
        self.step_s += _WEIGHT * (seconds - self.step_s)

    def answered(self, episode: str) -> None:
        """The episode acts from now on."""
        self._left[episode] = time.perf_counter()

    def asked(self, episode: str) -> None:
        """The episode is back."""
        left = self._left.pop(episode, None)
        if left is not None:
            self.away_s += _WEIGHT * (time.perf_counter() - left - self.away_s)

    def ended(self, episode: str) -> None:
        """The episode will not be back."""
        self._left.pop(episode, None)
