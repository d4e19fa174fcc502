"""How a name in a spec finds a class, and what that class costs and needs.

One plain dict per kind. A target is ``"module:Class"`` and is imported only when it is built. Every entry declares its
call profile (model calls per retrieve, store, step and episode) and what it needs of the backend, so that cost and
capability are known before a run. ``register`` adds methods of your own.

A method whose paper's settings are too dear for reinforcement learning has two cost presets, chosen by its parameter
``preset``: ``paper`` (the default) and ``rl``. Both profiles are declared; the contract tests hold them against what is
really called.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from agentspec.actions import suggest

Kind = Literal["env", "perception", "memory", "reasoning", "reflection"]


class SpecError(ValueError):
    """A spec, name or configuration that cannot work: what was given, what was expected, what to do."""


@dataclass(frozen=True)
class CallProfile:
    """Model calls as (fewest, most) per occasion under the parameters of a preset.

    A call is one request, whatever the number of samples it asks for. ``step`` is one decision (reasoning) or one
    revision (reflection); ``episode`` is what happens at an episode's end.
    """

    retrieve: tuple[int, int] = (0, 0)
    store: tuple[int, int] = (0, 0)
    step: tuple[int, int] = (0, 0)
    episode: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Entry:
    """One registered name.

    Args:
        target: ``"package.module:Class"`` (for environments: the gymnasium id).
        calls: the call profile under default parameters (preset ``paper`` where there are presets).
        purposes: what its calls are for (the part of a call's path after ``/``); ``train`` patterns match these.
        needs: backend capabilities or ``"snapshots"`` of the environment.
        summary: one line for ``agentspec list``.
        rl: the call profile of preset ``rl``; ``None`` for a method without presets.
        waived: need -> (parameter, value): with that value the method does without the need.
        envs: registered environments the method is written for; empty: any.
    """

    target: str
    calls: CallProfile = CallProfile()
    purposes: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    summary: str = ""
    rl: CallProfile | None = None
    waived: Mapping[str, tuple[str, Any]] = field(default_factory=dict)
    envs: tuple[str, ...] = ()

    @property
    def presets(self) -> dict[str, CallProfile]:
        """Call profile by preset; empty for a method without presets."""
        return {} if self.rl is None else {"paper": self.calls, "rl": self.rl}

    def needs_with(self, params: Mapping[str, Any]) -> tuple[str, ...]:
        """What the method needs when it is built with ``params``."""
        waived = {need for need, (name, value) in self.waived.items() if params.get(name) == value}
        return tuple(need for need in self.needs if need not in waived)

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
            "presets": {name: asdict(profile) for name, profile in self.presets.items()},
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
    """Register ``name``; ``declared`` are the other fields of :class:`Entry`."""
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
    "generic",
    "agentspec.perception.generic:GenericPerception",
    "image, instruction, state and action schema of any environment that keeps the contract",
    waived={"images": ("images", False)},
)
register(
    "perception",
    "deliverybench",
    "agentspec.perception.deliverybench:DeliveryBenchPerception",
    "the four components of DeliveryBench: image, instruction, state, action schema",
    waived={"images": ("images", False)},
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
    envs=("deliverybench",),
)
register(
    "reasoning",
    "random",
    "agentspec.reasoning.rule_based:RandomLegal",
    "a random sensible action: no model, the floor",
    envs=("deliverybench",),
)
register(
    "reasoning",
    "plan_and_solve",
    "agentspec.reasoning.plan_and_solve:PlanAndSolve",
    "a plan of sub-goals that persists, then one sub-goal at a time; plans anew when it fails or is done",
    calls=CallProfile(step=(1, 3)),
    rl=CallProfile(step=(1, 2)),
    purposes=("plan", "think", "act"),
)
register(
    "reasoning",
    "self_consistency",
    "agentspec.reasoning.self_consistency:SelfConsistency",
    "independent chains of thought, and a vote over their actions",
    calls=CallProfile(step=(1, 6)),
    rl=CallProfile(step=(1, 4)),
    purposes=("think", "act"),
    needs=("n",),
)
register(
    "reasoning",
    "mad",
    "agentspec.reasoning.mad:MultiAgentDebate",
    "agents answer, read each other's answers, answer again, and vote",
    calls=CallProfile(step=(9, 18)),
    rl=CallProfile(step=(4, 4)),
    purposes=("argue", "act"),
)
register(
    "reasoning",
    "tot",
    "agentspec.reasoning.tot:TreeOfThoughts",
    "a tree of short action sequences: propose, judge, prune, breadth or depth first",
    calls=CallProfile(step=(1, 20)),
    rl=CallProfile(step=(1, 8)),
    purposes=("propose", "value", "vote"),
    needs=("n",),
)
register(
    "reasoning",
    "rap",
    "agentspec.reasoning.rap:ReasoningViaPlanning",
    "Monte-Carlo tree search with the model as world model and judge",
    calls=CallProfile(step=(1, 91)),
    rl=CallProfile(step=(1, 16)),
    purposes=("propose", "world", "judge"),
    needs=("n", "score"),
    waived={"score": ("evaluation", "samples")},
)
register(
    "reasoning",
    "lats",
    "agentspec.reasoning.lats:LanguageAgentTreeSearch",
    "Monte-Carlo tree search in the environment itself, with judged values and reflections on failures",
    calls=CallProfile(step=(1, 1121)),
    rl=CallProfile(step=(1, 20)),
    purposes=("propose", "value", "reflect", "world"),
    needs=("n", "snapshots"),
    waived={"snapshots": ("world", "model")},
)

register("reflection", "none", "agentspec.reflection.none:NoReflection", "keeps every decision as it is")
register(
    "reflection",
    "self_refine",
    "agentspec.reflection.self_refine:SelfRefine",
    "a critic's feedback on the action before it is executed, and another attempt, until it is content",
    calls=CallProfile(step=(1, 6)),
    rl=CallProfile(step=(1, 2)),
    purposes=("feedback", "refine"),
)
register(
    "reflection",
    "reflexion",
    "agentspec.reflection.reflexion:Reflexion",
    "after a failed trial a lesson in words, shown in the next trials of the same task",
    calls=CallProfile(episode=(0, 1)),
    purposes=("reflect",),
)
register(
    "reflection",
    "retroformer",
    "agentspec.reflection.retroformer:Retroformer",
    "Reflexion with a reflector of its own to be trained on the change of return (untrained as it comes)",
    calls=CallProfile(episode=(0, 1)),
    purposes=("reflect",),
)


def call_table(kinds: tuple[str, ...] = ("memory", "reasoning", "reflection")) -> str:
    """The declared call profiles as a Markdown table, one row per module and preset: what the documentation shows."""
    occasions = ("retrieve", "store", "step", "episode")
    lines = [
        "| kind | module | preset | " + " | ".join(f"calls per {o}" for o in occasions) + " | purposes | needs |",
        "|---|---|---|" + "---|" * len(occasions) + "---|---|",
    ]
    for kind in kinds:
        for name, entry in sorted(REGISTRY.entries.get(kind, {}).items()):
            needs = [need + _waiver(entry, need) for need in entry.needs]
            for preset, profile in (entry.presets or {"": entry.calls}).items():
                counts = [_count(getattr(profile, occasion)) for occasion in occasions]
                row = [kind, f"`{name}`", f"`{preset}`" if preset else "", *counts]
                lines.append("| " + " | ".join([*row, ", ".join(entry.purposes), ", ".join(needs)]) + " |")
    return "\n".join(lines) + "\n"


def _count(span: tuple[int, int]) -> str:
    fewest, most = span
    return str(most) if fewest == most else f"{fewest}–{most}"


def _waiver(entry: Entry, need: str) -> str:
    if need not in entry.waived:
        return ""
    name, value = entry.waived[need]
    return f" (not with `{name}: {value}`)"
