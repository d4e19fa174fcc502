"""`agentspec list`: everything that can stand in a spec, with what it costs and needs."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import Any

from agentspec.registry import REGISTRY, CallProfile

KINDS = ("env", "perception", "memory", "reasoning", "reflection", "reward")


def add_parser(commands: Any) -> None:
    """Arguments of `agentspec list`."""
    parser = commands.add_parser(
        "list", help="list environments, modules and rewards", description="All registered names, by kind."
    )
    parser.add_argument("kind", nargs="?", choices=KINDS, help="only this kind")
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
    for kind, entries in names.items():
        print(kind)
        for name, entry in entries.items():
            notes = [note for note in (_calls(entry["calls"]), _needs(entry["needs"], entry.get("extra", ""))) if note]
            print(f"  {name:<16} {entry['summary']}{' (' + '; '.join(notes) + ')' if notes else ''}")
    return 0


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
