"""How a name in a spec finds a class, and what that class costs and needs.

One plain dict per kind. A target is ``"module:Class"`` and is imported only when it is built. Every entry declares its
call profile (model calls per retrieve, store, step and episode) and what it needs of the backend, so that cost and
capability are known before a run. ``register`` adds methods of your own.
"""

from __future__ import annotations

import importlib
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from agentspec.actions import suggest

Kind = Literal["env", "perception", "memory", "reasoning", "reflection"]


class SpecError(ValueError):
    """A spec, name or configuration that cannot work: what was given, what was expected, what to do."""


@dataclass(frozen=True)
class CallProfile:
    """Model calls as (fewest, most) per occasion under default parameters."""

    retrieve: tuple[int, int] = (0, 0)
    store: tuple[int, int] = (0, 0)
    step: tuple[int, int] = (0, 0)
    episode: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Entry:
    """One registered name.

    Args:
        target: ``"package.module:Class"`` (for environments: the gymnasium id).
        calls: the call profile.
        purposes: what its calls are for (the part of a call's path after ``/``); ``train`` patterns match these.
        needs: backend capabilities or ``"snapshots"`` of the environment.
        summary: one line for ``agentspec list``.
    """

    target: str
    calls: CallProfile = CallProfile()
    purposes: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    summary: str = ""

    def load(self) -> Any:
        """Import the target."""
        module, _, name = self.target.partition(":")
        return getattr(importlib.import_module(module), name)

    def describe(self) -> dict[str, Any]:
        """JSON of the entry, as ``agentspec list --json`` prints it."""
        return {
            "summary": self.summary,
            "calls": asdict(self.calls),
            "purposes": list(self.purposes),
            "needs": list(self.needs),
        }


@dataclass
class Registry:
    """All names, by kind."""

    entries: dict[str, dict[str, Entry]] = field(default_factory=dict)

    def register(self, kind: Kind, name: str, entry: Entry) -> None:
        """Add a name.

        Raises:
            SpecError: the name is taken by another target.
        """
        known = self.entries.setdefault(kind, {})
        if name in known and known[name].target != entry.target:
            raise SpecError(f"{kind} {name!r} is already registered as {known[name].target}; choose another name")
        known[name] = entry

    def get(self, kind: str, name: str) -> Entry:
        """The entry of ``name``.

        Raises:
            SpecError: unknown kind or name, with the nearest names.
        """
        known = self.entries.get(kind, {})
        if name not in known:
            raise SpecError(f"unknown {kind} {name!r}{suggest(name, known)}")
        return known[name]


REGISTRY = Registry()


def register(kind: Kind, name: str, target: str, summary: str, **declared: Any) -> None:
    """Register ``name``; ``declared`` are ``calls``, ``purposes`` and ``needs`` of :class:`Entry`."""
    REGISTRY.register(kind, name, Entry(target, summary=summary, **declared))


register(
    "env",
    "deliverybench",
    "agentspec/DeliveryBench-v0",
    "a courier earns money in a city: orders, deadlines, battery, energy, hot and cold food",
    needs=(),
)

register(
    "perception",
    "deliverybench",
    "agentspec.perception.deliverybench:DeliveryBenchPerception",
    "the four components of DeliveryBench: image, instruction, state, action schema",
)

register("memory", "none", "agentspec.memory.none:NoMemory", "remembers nothing")
register("memory", "base", "agentspec.memory.base:BaseMemory", "rolling buffer of the most recent steps")
register(
    "memory",
    "summary",
    "agentspec.memory.summary:SummaryMemory",
    "SUPO: the policy's own summary replaces the conversation every 8 actions",
    calls=CallProfile(store=(0, 1)),
    purposes=("summary",),
)

register(
    "reasoning",
    "direct",
    "agentspec.reasoning.direct:Direct",
    "answers with the action only",
    calls=CallProfile(step=(1, 1)),
    purposes=("act",),
)
register(
    "reasoning",
    "cot",
    "agentspec.reasoning.cot:ChainOfThought",
    "thinks step by step, then acts; the chain is not carried on",
    calls=CallProfile(step=(1, 2)),
    purposes=("think", "act"),
)
register(
    "reasoning",
    "react",
    "agentspec.reasoning.react:ReAct",
    "a growing transcript of thought, action and observation",
    calls=CallProfile(step=(1, 11)),
    purposes=("think", "act"),
)
register(
    "reasoning",
    "rule_based",
    "agentspec.reasoning.rule_based:RuleBased",
    "the environment's scripted expert: no model, a baseline and demonstrator",
)
register(
    "reasoning",
    "random",
    "agentspec.reasoning.rule_based:RandomLegal",
    "a random sensible action: no model, the floor",
)

register("reflection", "none", "agentspec.reflection.none:NoReflection", "keeps every decision as it is")
