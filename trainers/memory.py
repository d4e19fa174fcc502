"""A memory trained with its policy, as a configuration: what memory asks is among the trained calls.

There is no second trainer. What the policy writes into memory are rows like any other (`trainers.sequences`); what
they earn is `write_credit` (`trainers.writes`). This module checks that a configuration trains a memory and fills
in what follows from it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from agentspec.registry import SpecError
from trainers.checks import own_memory_paths

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig

PATTERN = "memory.*"


def as_memory(config: ScaffoldConfig) -> ScaffoldConfig:
    """Make `config` train what its agent's memory asks, beside what it trains already.

    Calls of memory join the trained calls and, since a memory's calls are help unless it says otherwise, `aux` the
    trained credits. Answers that were cut off at their length limit are context only.

    Raises:
        SpecError: the agent's memory asks the policy nothing.
    """
    if not own_memory_paths(config):
        raise SpecError(
            f"the agent's memory is {config.spec.memory.name!r}, and the policy is asked nothing for it; choose one "
            "that writes, `memory: dynamic_cheatsheet` say (`agentspec list memory` shows their calls)"
        )
    if not any(p.startswith("memory.") for p in config.train_calls):
        config.train_calls = [*config.train_calls, PATTERN]
    if "aux" not in config.train_credits:
        config.train_credits = [*config.train_credits, "aux"]
    if not config.mask_truncated:
        config.mask_truncated = [PATTERN]
    return config
