"""Steps of a run as a graph counts them, and as they are told: by episode and number."""

from __future__ import annotations

from agentspec.memory.parts.entries import Entry, stamp
from agentspec.services import Services, Time

MOST_EPISODES = 200
"""Episodes of a run whose beginnings are known; facts of earlier ones count as of the earliest of these."""


class Timeline:
    """When each episode of a run began, and facts with their times."""

    def __init__(self, services: Services) -> None:
        self.services = services
        self.begins: list[list[int]] = []  # episodes: the step of the run each began with, and its number

    def begin_episode(self) -> None:
        """An episode begins now."""
        now = self.services.time()
        self.begins = [*self.begins, [now.total - now.step, now.episode]][-MOST_EPISODES:]

    def shown(self, fact: Entry) -> str:
        """A fact with its times."""
        begin = stamp(self.time(fact.data["valid"]), self.services.time())
        if fact.data["invalid"] is None:
            return f"- {fact.text} [since {begin}]"
        end = stamp(self.time(fact.data["invalid"]), self.services.time())
        return f"- Not so any more: {fact.text} [from {begin} to {end}]"

    def time(self, total: int) -> Time:
        """A step of the run by episode and number."""
        now = self.services.time()
        known = [*self.begins, [now.total - now.step, now.episode]]
        began, episode = next((b for b in reversed(known) if b[0] <= total), known[0])
        return Time(episode, max(0, total - began), total)
