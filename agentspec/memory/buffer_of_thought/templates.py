"""Thought templates, and the coarse ones that stand in for a task without one."""

from __future__ import annotations

from dataclasses import dataclass

from agentspec.state import Record


@dataclass(frozen=True)
class Template(Record):
    """A way of working: what it is called, for which tasks it is, its steps, and how often it was looked up."""

    category: str
    description: str
    template: str
    uses: int = 0

    def text(self) -> str:
        """As the model reads it."""
        return f"{self.category}: {self.description}\n{self.template}"


COARSE = (
    Template(
        "one goal after another",
        "Reach a goal by a sequence of actions, each of which makes the next one possible.",
        "1. Name the goal and what is missing for it. 2. Take the first thing missing that can be had now. 3. After "
        "every action compare what was expected with what came. 4. If an action failed, remove its reason before it is "
        "tried again.",
    ),
    Template(
        "search",
        "Find or explore: the place of a thing, a room, a door or a key is unknown and must be looked for.",
        "1. List where it may be, the likeliest and nearest first. 2. Look there and note what was seen. 3. Never look "
        "twice where nothing can have changed. 4. Once it is found, go straight for it.",
    ),
    Template(
        "several jobs against the clock",
        "Earn or deliver as much as possible before time is up: orders, deadlines, pay, distances and limited energy.",
        "1. Of each job work out pay per minute with the way there. 2. Take jobs whose stops lie on one way, and none "
        "that cannot be done in time. 3. Order the stops by deadline, then by distance. 4. Use waiting time, and "
        "refill before it runs out. 5. Plan anew when something changes.",
    ),
)
