"""SUPO and the training of a memory as configurations: there is no second trainer.

*SUPO* (arXiv 2510.06727) is GRPO with a summary schedule, trained summaries and overlong masking. Each segment between
two summaries (`agentspec.memory.summary`) is a row, the advantage belongs to the rollout, and an episode that ran out
of context gets zero loss while it stays in the baseline (`overlong: mask`).

*A memory* is trained with its policy when what it asks is among the trained calls; what its writes earn is
`write_credit` (`trainers.writes`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from agentspec.registry import SpecError
from agentspec.spec import ModuleSpec
from trainers.checks import own_memory_paths

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig


def as_supo(config: ScaffoldConfig, *, every: int = 8) -> ScaffoldConfig:
    """Make `config` train with periodic summaries: the agent's memory becomes `summary`, unless it is already.

    Raises:
        SpecError: another memory is configured, or the layout keeps no conversation to summarise.
    """
    spec = config.spec
    if spec.memory.name not in ("none", "summary"):
        raise SpecError(
            f"SUPO replaces the conversation by the policy's own summary, but the agent's memory is "
            f"{spec.memory.name!r}; set `memory: summary` (or none)"
        )
    if spec.layout != "conversation":
        raise SpecError("SUPO summarises a conversation; set `layout: conversation`")
    if spec.memory.name == "none":
        spec = replace(spec, memory=ModuleSpec("summary", {"every": every}))
    config.agent = spec.to_data()
    return _also_trained(config, "memory.summary")


def as_memory(config: ScaffoldConfig) -> ScaffoldConfig:
    """Make `config` train what its agent's memory asks, beside what it trains already.

    A memory's calls are help unless it says otherwise: `aux` joins the trained credits.

    Raises:
        SpecError: the agent's memory asks the policy nothing.
    """
    if not own_memory_paths(config):
        raise SpecError(
            f"the agent's memory is {config.spec.memory.name!r}, and the policy is asked nothing for it; choose one "
            "that writes, `memory: dynamic_cheatsheet` say (`agentspec list memory` shows their calls)"
        )
    if "aux" not in config.train_credits:
        config.train_credits = [*config.train_credits, "aux"]
    return _also_trained(config, "memory.*")


def _also_trained(config: ScaffoldConfig, pattern: str) -> ScaffoldConfig:
    """Train such calls, unless some are named; answers that were cut off at their length limit are context only."""
    if not any(p.startswith(pattern.removesuffix("*")) for p in config.train_calls):
        config.train_calls = [*config.train_calls, pattern]
    config.mask_truncated = config.mask_truncated or [pattern]
    return config
