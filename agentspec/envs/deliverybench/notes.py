"""What the courier would note of a shift: where it stands, and what has become of each order it took.

See `agentspec.demonstration`. Read off the compact observation; of the full one its first line.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from agentspec.types import AgentInput

ORDER = re.compile(r"order (\d+): (.+)")


def notes(inputs: Sequence[AgentInput]) -> list[str]:
    """Sentences about what was seen, newest last."""
    if not inputs:
        return []
    head, *lines = [line for line in inputs[-1].text.splitlines() if line and not line.startswith("choices:")] or [""]
    held = [f"Order {found[1]}: {found[2]}." for line in lines if (found := ORDER.match(line))]
    return [f"{head}.", *held]
