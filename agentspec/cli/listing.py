"""`agentspec list`: everything that can stand in a spec, with what it costs and needs."""

from __future__ import annotations

import argparse
import json
import textwrap
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from agentspec.registry import REGISTRY, CallProfile

WIDTH = 116
KINDS = ("env", "perception", "memory", "reasoning", "reflection", "reward")


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec list`."""
    parser = commands.add_parser(
        "list", help="list environments, modules and rewards", description="All registered names, by kind."
    )
    parser.add_argument("kind", nargs="?", type=_kind, choices=KINDS, help="only this kind; plurals are fine")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(command=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the registries."""
    names = registered()
    if arguments.kind:
        names = {arguments.kind: names[arguments.kind]}
    if arguments.json:
        print(json.dumps(names, indent=2))
        return 0
    print("\n".join(lines(names)))
    return 0


def lines(names: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The registries as text: names in a column of their own, what is long goes on under itself."""
    wide = max(map(len, (name for entries in names.values() for name in entries)), default=0)
    found = []
    for kind, entries in names.items():
        found.append(kind)
        for name, entry in entries.items():
            notes = "; ".join(
                note for note in (_calls(entry["calls"]), _needs(entry["needs"], entry.get("extra", ""))) if note
            )
            text = entry["summary"] + (f" ({notes})" if notes else "")
            found += textwrap.wrap(
                text, WIDTH, initial_indent=f"  {name:<{wide}}  ", subsequent_indent=" " * (wide + 4)
            ) or [f"  {name}"]
    return found


def _kind(text: str) -> str:
    """`memories` or `Memory` as `memory`."""
    kind = text.lower()
    return next((k for k in KINDS if kind in (k, f"{k}s", f"{k[:-1]}ies")), kind)


def registered() -> dict[str, dict[str, Any]]:
    """Kind -> name -> summary, call profile, purposes and needs (and the gymnasium id of environments)."""
    from rewards import REWARDS

    found: dict[str, dict[str, Any]] = {
        kind: {name: entry.describe() for name, entry in sorted(REGISTRY.entries.get(kind, {}).items())}
        for kind in KINDS[:-1]
    }
    for name, description in found["env"].items():
        description["id"] = REGISTRY.get("env", name).target
    nothing = {"calls": asdict(CallProfile()), "purposes": [], "needs": []}
    found["reward"] = {name: {"summary": entry.summary, **nothing} for name, entry in sorted(REWARDS.items())}
    return found


def _calls(profile: dict[str, Any]) -> str:
    """`1-2 calls per step`; empty for methods that call no model."""
    parts = []
    for occasion, (fewest, most) in profile.items():
        if most:
            count = str(most) if fewest == most else f"{fewest}-{most}"
            parts.append(f"{count} {'call' if count == '1' else 'calls'} per {occasion}")
    return ", ".join(parts)


def _needs(needs: list[str], extra: str) -> str:
    needed = [*needs, f"extra {extra}"] if extra else needs
    return f"needs {', '.join(needed)}" if needed else ""
