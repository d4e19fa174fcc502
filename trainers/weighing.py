"""Episodes -> rows with advantages: the one place where an update's credit is decided.

Returns are gathered over all ranks (a group may span them); everything else is local. An episode that could not be
scored counts in no baseline and has no rows. An overlong episode is masked, kept or dropped as configured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from agentspec.trajectory import Trajectory
from rewards import RewardSet
from trainers.advantages import ESTIMATORS, zero_variance
from trainers.batches import Row
from trainers.checks import STEP_ESTIMATORS
from trainers.config import ScaffoldConfig
from trainers.sequences import TokenSequence, build_sequences
from trainers.step_advantages import gigpo, reward_to_go

Gather = Callable[[list[object]], list[object]]


@dataclass(frozen=True)
class EpisodeCredit:
    """What one rank knows of one of its episodes, before groups are formed."""

    rewards: tuple[float, ...] | None
    anchors: tuple[str, ...]
    overlong: bool

    @property
    def total(self) -> float:
        """Return of the episode; NaN if unscorable."""
        return math.nan if self.rewards is None else math.fsum(self.rewards)


@dataclass(frozen=True)
class Weighed:
    """Rows of this rank with their advantages, and what the logs say about them."""

    rows: list[Row]
    metrics: dict[str, float]


def is_overlong(trajectory: Trajectory, ends: Sequence[str]) -> bool:
    """Whether the episode ended for a reason in ``ends``."""
    ended = str(trajectory.metrics.get("ended", "environment"))
    cut = bool(trajectory.transitions) and trajectory.transitions[-1].truncated
    return ended in ends or ("truncated" in ends and cut)


def weigh(
    episodes: Sequence[Trajectory],
    config: ScaffoldConfig,
    rewards: RewardSet,
    *,
    group: int,
    rank: int = 0,
    gather: Gather = list,
) -> Weighed:
    """Advantages of all rollouts, given to all sequences of this rank's episodes.

    Args:
        episodes: this rank's episodes; ranks hold equally many, in the order of the global batch.
        group: rollouts per task.
        gather: list of this rank -> concatenated lists of all ranks.
    """
    local = [_credit(t, config, rewards) for t in episodes]
    everyone: list[EpisodeCredit] = gather(list(local))  # type: ignore[assignment]
    returns = torch.tensor([math.nan if _dropped(c, config) else c.total for c in everyone], dtype=torch.float64)
    grouped = returns.view(-1, group)
    silent = zero_variance(grouped).repeat_interleave(group)
    advantages = _advantages(everyone, grouped, config, group)
    first = rank * len(episodes)
    rows: list[Row] = []
    for i, trajectory in enumerate(episodes):
        credit = everyone[first + i]
        if returns[first + i].isnan() or (config.overlong == "mask" and credit.overlong):
            continue
        if config.skip_zero_variance and bool(silent[first + i]):
            continue
        for sequence in build_sequences(trajectory, config.train_filter):
            rows.append(Row(sequence, _per_token(sequence, advantages[first + i]), i))
    if config.normalize == "rollout":
        rows = _per_rollout(rows, gather)
    metrics = _metrics(everyone, returns, silent, rows, len(episodes)) | _truncated(episodes, config)
    return Weighed(rows, metrics)


def _per_rollout(rows: Sequence[Row], gather: Gather) -> list[Row]:
    """Scale advantages so that every rollout weighs the same, however many tokens its scaffold trained.

    The loss divides by all N trained tokens; a rollout with n of them counts n / N. With the factor N / (R n), R
    rollouts with something to train, it counts 1 / R: the mean over rollouts of their mean over tokens.
    """
    counts: dict[int, int] = {}
    for row in rows:
        counts[row.episode] = counts.get(row.episode, 0) + row.sequence.trained
    everywhere = [int(str(n)) for n in gather(list(counts.values()))]
    total, rollouts = sum(everywhere), len(everywhere)
    return [replace(row, advantage=_times(row.advantage, total / (rollouts * counts[row.episode]))) for row in rows]


def _times(advantage: float | tuple[float, ...], factor: float) -> float | tuple[float, ...]:
    return advantage * factor if isinstance(advantage, float) else tuple(a * factor for a in advantage)


def _credit(trajectory: Trajectory, config: ScaffoldConfig, rewards: RewardSet) -> EpisodeCredit:
    terms = rewards.steps(trajectory)
    steps: tuple[float, ...] | None = None
    if terms is not None:
        columns = [[rewards.weights[name] * v for v in values] for name, values in terms.items()]
        steps = tuple(math.fsum(column) for column in zip(*columns, strict=True))
    anchors = tuple(t.input.text for t in trajectory.transitions) if config.estimator == "gigpo" else ()
    return EpisodeCredit(steps, anchors, is_overlong(trajectory, config.overlong_ends))


def _dropped(credit: EpisodeCredit, config: ScaffoldConfig) -> bool:
    return config.overlong == "drop" and credit.overlong


def _advantages(
    everyone: Sequence[EpisodeCredit], grouped: torch.Tensor, config: ScaffoldConfig, group: int
) -> Sequence[float | list[float]]:
    """Per episode a number, or a list with one per step."""
    if config.estimator not in STEP_ESTIMATORS:
        values: list[float] = ESTIMATORS[config.estimator](grouped).flatten().tolist()
        return values
    result: list[list[float]] = []
    for start in range(0, len(everyone), group):
        members = everyone[start : start + group]
        steps = [None if _dropped(c, config) else c.rewards for c in members]
        if config.estimator == "reward_to_go":
            result += reward_to_go(steps, gamma=config.gamma)
        else:
            anchors = [c.anchors for c in members]
            result += gigpo(steps, anchors, gamma=config.gamma, weight=config.gigpo_weight)
    return result


def _per_token(sequence: TokenSequence, advantage: float | list[float]) -> float | tuple[float, ...]:
    """The episode's number, or each trained token's step value."""
    if isinstance(advantage, float):
        return advantage
    return tuple(advantage[s] if m else 0.0 for s, m in zip(sequence.steps, sequence.mask, strict=True))


def _metrics(
    everyone: Sequence[EpisodeCredit], returns: torch.Tensor, silent: torch.Tensor, rows: Sequence[Row], episodes: int
) -> dict[str, float]:
    trained = [r.sequence.trained for r in rows]
    return {
        "groups/zero_variance": silent.float().mean().item(),
        "rollouts/unscorable": sum(c.rewards is None for c in everyone) / len(everyone),
        "rollouts/overlong": sum(c.overlong for c in everyone) / len(everyone),
        "rollouts/rows_per_episode": len(rows) / max(1, episodes),
        "rollouts/trained_tokens": float(sum(trained)),
        "rollouts/multi_row_episodes": sum(_counts(rows)[e] > 1 for e in _counts(rows)) / max(1, episodes),
    }


def _truncated(episodes: Sequence[Trajectory], config: ScaffoldConfig) -> dict[str, float]:
    """Per kind of trained call: the share of completions that hit their length limit (a summary cut off, say)."""
    cut: dict[str, list[bool]] = {}
    for call in (c for t in episodes for c in t.calls if config.train_filter.matches(c.tag.path)):
        cut.setdefault(call.tag.path, []).extend(c.finish_reason == "length" for c in call.completions)
    return {f"calls/{path}/truncated": sum(flags) / len(flags) for path, flags in cut.items() if flags}


def _counts(rows: Sequence[Row]) -> dict[int, int]:
    counts: dict[int, int] = {}
    for row in rows:
        counts[row.episode] = counts.get(row.episode, 0) + 1
    return counts
