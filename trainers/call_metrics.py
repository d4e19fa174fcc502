"""What an update does to each kind of call: which parts of the scaffold reinforcement learning changes.

Trained tokens are counted by the `module/purpose` path of the call that wrote them. An update that moves the
summaries and leaves the actions alone shows here, and nowhere else.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import torch

from agentspec.trajectory import Trajectory
from trainers.sequences import Row, TrainFilter


class CallMetrics:
    """Gathers, per path, sums over its trained tokens until they are logged."""

    def __init__(self) -> None:
        self._totals: defaultdict[str, Any] = defaultdict(Counter)

    def add(self, rows: Sequence[Row], entropies: torch.Tensor, clipped: torch.Tensor) -> None:
        """Count one micro-batch.

        Args:
            entropies: (B, L-1), nats, aligned with `completion_ids`.
            clipped: (B, L-1), whether the loss clipped the token's ratio.
        """
        for row, entropy, cut in zip(rows, entropies.tolist(), clipped.tolist(), strict=True):
            sequence = row.sequence
            for place in (i for i, trained in enumerate(sequence.mask) if trained):
                totals = self._totals[sequence.paths[sequence.calls[place]]]
                advantage = row.advantage if isinstance(row.advantage, int | float) else row.advantage[place]
                totals["tokens"] += 1
                totals["advantage"] += abs(advantage)
                totals["entropy"] += entropy[place - 1]
                totals["clipped"] += bool(cut[place - 1])

    def flush(self, gather: Callable[[list[Any]], list[Any]] = list) -> dict[str, float]:
        """Metrics of what was counted since the last time, over all ranks.

        Per path: `tokens` (trained), `advantage_mass` (its share of the sum of absolute advantages over trained
        tokens), `entropy` (mean, nats), `clip_share` (of its tokens).
        """
        everywhere: defaultdict[str, Any] = defaultdict(Counter)
        for path, totals in gather(list(self._totals.items())):
            everywhere[path].update(totals)
        self._totals = defaultdict(Counter)
        mass = sum(t["advantage"] for t in everywhere.values())
        metrics: dict[str, float] = {}
        for path, t in sorted(everywhere.items()):
            metrics[f"calls/{path}/tokens"] = float(t["tokens"])
            metrics[f"calls/{path}/advantage_mass"] = t["advantage"] / mass if mass else 0.0
            metrics[f"calls/{path}/entropy"] = t["entropy"] / t["tokens"]
            metrics[f"calls/{path}/clip_share"] = t["clipped"] / t["tokens"]
        return metrics


def truncated_calls(episodes: Sequence[Trajectory], train: TrainFilter) -> dict[str, float]:
    """Per kind of trained call: the share of completions that hit their length limit (a summary cut off, say)."""
    cut: dict[str, list[bool]] = {}
    for call in (c for t in episodes for c in t.calls if train.matches(c.tag.path)):
        cut.setdefault(call.tag.path, []).extend(c.finish_reason == "length" for c in call.completions)
    return {f"calls/{path}/truncated": sum(flags) / len(flags) for path, flags in cut.items() if flags}
