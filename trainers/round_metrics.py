"""What is logged of a generation round, under TRL's names where TRL has one.

A *completion*, where TRL speaks of one, is everything that the policy chose in an episode: the trained tokens of all
its calls. Figures are over the episodes of all ranks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from trl.trainer.utils import nanstd

from agentspec.metrics import figures, means
from agentspec.trajectory import Trajectory
from trainers.credit import Gather, ScoredEpisode
from trainers.sequences import TrainFilter, trained_completions


@dataclass(frozen=True)
class Played:
    """What the logs need of an episode: its reward terms, unweighted (`None` if it failed), and its completion."""

    terms: Mapping[str, float] | None
    length: int
    clipped: bool

    @classmethod
    def of(cls, episode: ScoredEpisode, train: TrainFilter) -> Played:
        """Of a scored episode."""
        completions = [c for _, c in trained_completions(episode.trajectory, train)]
        free = [a is None or len(a) > 1 for c in completions for a in c.allowed or (None,) * len(c.token_ids)]
        clipped = bool(completions) and completions[-1].finish_reason == "length"
        return cls(None if episode.score is None else episode.score.sums, sum(free), clipped)


def round_metrics(
    episodes: Sequence[ScoredEpisode],
    train: TrainFilter,
    weights: Mapping[str, float],
    *,
    group: int,
    gather: Gather = list,
) -> dict[str, float]:
    """Rewards as TRL computes them (`weights` by reward, `group` rollouts per task), and lengths in trained tokens."""
    everyone: list[Played] = gather([Played.of(e, train) for e in episodes])
    values = torch.tensor([[math.nan if p.terms is None else p.terms[name] for name in weights] for p in everyone])
    totals = (values * torch.tensor(list(weights.values()))).sum(dim=1)
    deviations = nanstd(totals.view(-1, group), dim=1)
    metrics: dict[str, float] = {}
    for name, column in zip(weights, values.T, strict=True):
        metrics[f"rewards/{name}/mean"] = column.nanmean().item()
        metrics[f"rewards/{name}/std"] = nanstd(column).item()
    metrics["reward"] = totals.nanmean().item()
    metrics["reward_std"] = nanstd(totals).item()
    metrics["frac_reward_zero_std"] = deviations.isclose(torch.zeros_like(deviations)).float().mean().item()
    metrics["completions/clipped_ratio"] = sum(p.clipped for p in everyone) / len(everyone)
    ended = [p.length for p in everyone if not p.clipped] or [0]
    for kind, lengths in (("length", [p.length for p in everyone]), ("terminated_length", ended)):
        metrics[f"completions/mean_{kind}"] = sum(lengths) / len(lengths)
        metrics[f"completions/min_{kind}"] = float(min(lengths))
        metrics[f"completions/max_{kind}"] = float(max(lengths))
    return metrics


class SamplingMetrics:
    """How far log-probabilities of the update are from those that sampled, gathered until they are logged.

    `differences` (absolute) and, where vLLM's kernels sampled, `ratios` hold a value per trained token of each
    micro-batch.
    """

    def __init__(self) -> None:
        self.differences: list[torch.Tensor] = []
        self.ratios: list[torch.Tensor] = []

    def flush(self, gather: Gather = list) -> dict[str, float]:
        """`sampling/logp_difference_max`, NaN if any is; with ratios, what TRL logs of vLLM: without NaN, as there."""
        differences, ratios = self.differences, self.ratios
        self.differences, self.ratios = [], []
        metrics = {}
        if differences:
            metrics["sampling/logp_difference_max"], trl = _summary(differences, gather)
            if ratios:
                metrics |= {f"sampling/sampling_logp_difference/{name}": trl[name] for name in ("mean", "max")}
        if ratios:
            found = _summary(ratios, gather)[1]
            metrics |= {f"sampling/importance_sampling_ratio/{name}": value for name, value in found.items()}
        return metrics


def _summary(values: Sequence[torch.Tensor], gather: Gather) -> tuple[float, dict[str, float]]:
    """Over all ranks: the greatest value, NaN if any is; `min`, `mean` and `max` of those that are not (0 of none)."""
    flat = torch.cat([v.detach().double().cpu() for v in values])
    known = flat[~flat.isnan()]
    mine = [flat.numel() - known.numel(), known.numel(), known.sum().item()]
    mine += [known.min().item(), known.max().item()] if known.numel() else [math.inf, -math.inf]
    rows = torch.tensor(gather([mine]), dtype=torch.float64)
    count, total = rows[:, 1].sum().item(), rows[:, 2].sum().item()
    found = {"min": rows[:, 3].min().item(), "mean": total / max(1, count), "max": rows[:, 4].max().item()}
    found = found if count else dict.fromkeys(found, 0.0)
    return (math.nan if rows[:, 0].any() else found["max"]), found


def episode_metrics(trajectories: Sequence[Trajectory]) -> dict[str, float]:
    """`episode/NAME`: mean figures of the episodes that did not fail: what `agentspec.metrics.figures` says of each."""
    return {f"episode/{name}": mean for name, mean in means(figures(t) for t in trajectories if t.scorable).items()}


def named(reward: str) -> Callable[..., Any]:
    """A reward function as TRL wants one, by name only: episodes are scored before credit, not by TRL."""

    def score(**_: Any) -> Any:
        raise NotImplementedError("episodes are scored once, as they are played")

    score.__name__ = reward
    return score
