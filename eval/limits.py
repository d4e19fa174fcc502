"""What an episode and a cell of the matrix may take: seconds, tokens, dollars."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from agentspec.actions import suggest
from agentspec.registry import SpecError


@dataclass(frozen=True)
class Limits:
    """Upper bounds; `None` is none. A cell is one policy (and training run) under one scaffold.

    An episode that takes longer than `episode_s` fails, and what its calls took is not known. A cell that has spent its
    share starts no further episode; those under way are played to their end, so it may spend a little more. What its
    finished episodes took, failed ones too, is counted from the store, over all starts of the evaluation.

    Args:
        episode_s: seconds of one episode, on the wall.
        cell_s: seconds of a cell: the sum over its episodes, which may run side by side.
        cell_tokens: input and output tokens.
        cell_dollars: by the price table.
    """

    episode_s: float | None = None
    cell_s: float | None = None
    cell_tokens: float | None = None
    cell_dollars: float | None = None

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, int | float) or not value > 0):
                raise SpecError(f"limits: {item.name} must be a number above 0, got {value!r}")

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Limits:
        """From YAML.

        Raises:
            SpecError: an unknown name, or a value that is no limit.
        """
        names = [item.name for item in fields(cls)]
        for name in data:
            if name not in names:
                raise SpecError(f"unknown key {name!r} in limits{suggest(str(name), names)}")
        return cls(**data)

    def spent(self, records: Iterable[Mapping[str, Any]]) -> str:
        """Which limit of a cell its episodes have reached, in words; empty if none."""
        totals = {"cell_s": 0.0, "cell_tokens": 0.0, "cell_dollars": 0.0}
        for record in records:
            totals["cell_s"] += float(record.get("wall_s") or 0)
            tokens, dollars = taken(record["episode"])
            totals["cell_tokens"] += tokens
            totals["cell_dollars"] += dollars
        for name, total in totals.items():
            most = getattr(self, name)
            if most is not None and total >= most:
                return f"{name}: {total:.6g} of {most:.6g} spent"
        return ""


def taken(row: Mapping[str, Any]) -> tuple[float, float]:
    """Tokens (in and out) and dollars of an episode; of one that failed, which has no figures, those of its calls."""
    sums = list(row.get("modules", {}).values()) if row.get("status") == "failed" else [row]
    tokens = sum((s.get("input_tokens") or 0) + (s.get("output_tokens") or 0) for s in sums)
    return float(tokens), float(sum(s.get("cost") or 0 for s in sums))
