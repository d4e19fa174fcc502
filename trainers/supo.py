"""SUPO (arXiv 2510.06727) as a configuration: GRPO with a summary schedule, trained summaries and overlong masking.

There is no second trainer. Summaries come from `agentspec.memory.summary`; each segment between two of them is a
row (`trainers.sequences`), the advantage belongs to the rollout (`trainers.credit`), and an episode that
ran out of context gets zero loss while it stays in the baseline (`overlong: mask`). This module checks that a
configuration is SUPO and fills in what follows from it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from agentspec.registry import SpecError
from agentspec.spec import ModuleSpec

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig

MEMORY = "summary"
PATTERN = f"memory.{MEMORY}"


def as_supo(config: ScaffoldConfig, *, every: int = 8) -> ScaffoldConfig:
    """Make `config` train with periodic summaries.

    The agent's memory becomes `summary` (every `every` actions) unless it is already, summaries join the trained
    calls, and summaries that hit their length limit are context only.

    Raises:
        SpecError: another memory is configured, or the layout keeps no conversation to summarise.
    """
    spec = config.spec
    if spec.memory.name not in ("none", MEMORY):
        raise SpecError(
            f"SUPO replaces the conversation by the policy's own summary, but the agent's memory is "
            f"{spec.memory.name!r}; set `memory: summary` (or none)"
        )
    if spec.layout != "conversation":
        raise SpecError("SUPO summarises a conversation; set `layout: conversation`")
    data = spec.to_data()
    if spec.memory.name == "none":
        data["memory"] = ModuleSpec(MEMORY, {"every": every}).to_data()
    config.agent = data
    if not any(p.startswith(PATTERN) for p in config.train_calls):
        config.train_calls = [*config.train_calls, PATTERN]
    if not config.mask_truncated:
        config.mask_truncated = [PATTERN]
    return config
