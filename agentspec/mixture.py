"""A mixture of scaffolds: reasoners x memories x layouts as data, and scaffolds that are kept out of it.

```yaml
agent: {sampling: {temperature: 1.0, max_tokens: 24}}        # what they share
scaffolds:
  - {reasoning: direct, memory: [none, base], layout: [conversation, snapshot]}        # four
  - {reasoning: react, memory: {name: dynamic_cheatsheet, preset: rl}, layout: snapshot}
held_out:
  - {reasoning: mad}                                         # in every layout, with every memory
```

A list stands for alternatives, and an entry for all their combinations.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.registry import SpecError
from agentspec.spec import AgentSpec

NAMED = ("reasoning", "memory", "reflection", "layout")
"""What tells scaffolds of a mixture apart."""


def mixture(shared: Mapping[str, Any], given: Any, held_out: Any = None) -> list[AgentSpec]:
    """The scaffolds of a mixture, each once; without one the agent alone.

    Args:
        shared: an agent as plain data; what an entry gives replaces it.
        given: an entry, or a list of them.
        held_out: entries of scaffolds that must not be in the mixture: all that agree with what an entry names.

    Raises:
        SpecError: no entry, one that is no agent, or a held-out scaffold in the mixture.
    """
    entries = [given] if isinstance(given, Mapping) else [{}] if given is None else given
    if not isinstance(entries, Sequence) or isinstance(entries, str) or not entries:
        raise SpecError(f"scaffolds: expected a mapping of modules, or a list of such, got {given!r}")
    specs = [AgentSpec.from_data({**shared, **one}) for entry in entries for one in combinations(entry)]
    unique = [spec for i, spec in enumerate(specs) if spec not in specs[:i]]
    for entry in held_out or []:
        for kept in combinations(entry):
            if found := [spec.label for spec in unique if _agrees(spec, kept)]:
                raise SpecError(f"held_out: {kept} is in the mixture ({', '.join(found)}); take it out of one of them")
    return unique


def combinations(entry: Any) -> list[dict[str, Any]]:
    """All combinations of the alternatives that an entry lists.

    Raises:
        SpecError: no mapping, or an empty list of alternatives.
    """
    if not isinstance(entry, Mapping):
        raise SpecError(f"scaffolds: expected a mapping such as {{reasoning: react, memory: base}}, got {entry!r}")
    ways = [value if isinstance(value, list) and key in NAMED else [value] for key, value in entry.items()]
    if not all(ways):
        raise SpecError(f"scaffolds: an empty list of alternatives in {dict(entry)}")
    return [dict(zip(entry, way, strict=True)) for way in itertools.product(*ways)]


def _agrees(spec: AgentSpec, named: Mapping[str, Any]) -> bool:
    """Whether a scaffold is one of those that an entry names; parameters count only where the entry gives some."""
    wanted = AgentSpec.from_data(dict(named))
    for kind in named:
        mine, other = getattr(spec, kind), getattr(wanted, kind)
        if kind in NAMED[:3] and not other.params:
            mine, other = mine.name, other.name
        if mine != other:
            return False
    return True
