"""Credit: from the scored episodes of an update to rows with advantages.

A `CreditRule` is everything that credit depends on: a run's configuration gives it to the trainer, the run's manifest
to whoever checks the run. It looks at whole episodes: one that could not be scored counts in no baseline and has no
rows; an overlong one is masked, kept or dropped; all sequences of an episode share its advantage.

A token of step t earns what its episode earns from step t on (estimators per step), or all of it (per episode). What
memory writes may be credited by estimators of its own, from episodes played beside the batch (`trainers.writes`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from agentspec.trajectory import Trajectory
from rewards import RewardSet, Score
from trainers.estimators import estimator, grpo
from trainers.sequences import Advantage, Row, TokenSequence, TrainFilter, build_sequences
from trainers.writes import EVERY, Advantages, Paired, Plan, WriteReturn, WriteRule

Gather = Callable[[list[Any]], list[Any]]
"""List of this rank -> the concatenated lists of all ranks."""


@dataclass(frozen=True)
class ScoredEpisode:
    """An episode and what it earned; `score` is `None` if it failed.

    `beside` are its counterfactuals, each with its plan, where writes are credited by them.
    """

    trajectory: Trajectory
    score: Score | None
    beside: tuple[tuple[Plan, ScoredEpisode], ...] = ()

    @property
    def total(self) -> float | None:
        """The weighted return; `None` if the episode failed."""
        return None if self.score is None else self.score.total

    def rest(self, step: int) -> float | None:
        """What the episode earned from `step` on; `None` if it failed."""
        return None if self.score is None else math.fsum(self.score.steps[max(0, step) :])


@dataclass(frozen=True)
class Outcome:
    """What every rank must know of an episode before groups can be formed.

    `rewards` are per step, `None` if it could not be scored; `anchors` the states that actions were taken in, where
    the estimator needs them; `beside` is what its counterfactuals earned.
    """

    rewards: tuple[float, ...] | None
    anchors: tuple[str, ...] = ()
    overlong: bool = False
    beside: tuple[WriteReturn, ...] = ()


@dataclass(frozen=True)
class Credited:
    """Rows of this rank with their advantages, and what the logs say about them."""

    rows: list[Row]
    metrics: dict[str, float]


SAME = ("estimator", "gamma", "gigpo_weight", "normalize", "overlong", "skip_zero_variance")
WRITE_FIELDS = ("write_credit", "write_calls", "write_rerolls", "write_points")
TRAINED_FIELDS = ("train_calls", "train_credits", "mask_truncated")
FIELDS = (*SAME, "num_generations", "overlong_ends", "rewards", *TRAINED_FIELDS, *WRITE_FIELDS)
"""Fields of a configuration that credit depends on; those of `SAME` are called so in the rule too."""


@dataclass(frozen=True)
class CreditRule:
    """How episodes are credited; what is not told here is told of the same field of `trainers.config.ScaffoldConfig`.

    Args:
        group: rollouts per task; episodes come in whole groups.
        train: which completions are trained.
        rewards: reward name -> weight.
        writes: how what memory writes is credited.
    """

    group: int
    estimator: str = "grpo"
    gamma: float = 1.0
    gigpo_weight: float = 1.0
    normalize: str = "token"
    overlong: str = "mask"
    overlong_ends: tuple[str, ...] = ("context",)
    skip_zero_variance: bool = False
    train: TrainFilter = field(default_factory=TrainFilter)
    rewards: Mapping[str, float] = field(default_factory=lambda: {"earning_delta": 1.0})
    writes: WriteRule = field(default_factory=WriteRule)

    @classmethod
    def from_manifest(cls, config: Mapping[str, Any]) -> CreditRule:
        """The rule of a run, from the fields of its configuration (in its manifest, say)."""
        if missing := [name for name in FIELDS if name not in config]:
            raise ValueError(f"the recorded configuration lacks {', '.join(missing)}, which credit depends on")
        given: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in config.items()}
        rewards = given["rewards"]
        return cls(
            group=given["num_generations"],
            overlong_ends=given["overlong_ends"],
            train=TrainFilter(*(given[name] for name in TRAINED_FIELDS)),
            rewards=RewardSet({rewards: 1.0} if isinstance(rewards, str) else rewards).weights,
            writes=WriteRule(*(given[name] for name in WRITE_FIELDS)),
            **{name: given[name] for name in SAME},
        )

    def score(self, trajectories: Sequence[Trajectory]) -> list[ScoredEpisode]:
        """Recorded episodes with their scores."""
        rewards = RewardSet(self.rewards)
        return [ScoredEpisode(t, rewards.score(t)) for t in trajectories]

    def outcome(self, episode: ScoredEpisode) -> Outcome:
        """What groups are formed of."""
        trajectory = episode.trajectory
        anchors = "anchors" in estimator(self.estimator).needs
        return Outcome(
            None if episode.score is None else episode.score.steps,
            tuple(t.input.text for t in trajectory.transitions) if anchors else (),
            is_overlong(trajectory, self.overlong_ends),
            tuple(WriteReturn(plan, other.rest(plan.step)) for plan, other in episode.beside),
        )

    def advantages(self, outcomes: Sequence[Outcome]) -> list[float | list[float] | None]:
        """Per rollout of whole groups its advantage, or one per step; `None` for a rollout that counts nowhere."""
        if len(outcomes) % self.group:
            raise ValueError(f"{len(outcomes)} episodes are no whole groups of {self.group}")
        spec = estimator(self.estimator)
        result: list[float | list[float] | None] = [None] * len(outcomes)
        for group in self._groups(len(outcomes)):
            places = [i for i in group if self._counts(outcomes[i])]
            rewards = [outcomes[i].rewards or () for i in places]
            given = {"gamma": self.gamma, "gigpo_weight": self.gigpo_weight}
            needed = given | {"anchors": [outcomes[i].anchors for i in places]}
            values: Any = rewards if spec.per_step else [math.fsum(r) for r in rewards]
            values = spec.function(values, **{name: needed[name] for name in spec.needs})
            for i, value in zip(places, values, strict=True):
                result[i] = value
        return result

    def credit(self, episodes: Sequence[ScoredEpisode], *, rank: int = 0, gather: Gather = list) -> Credited:
        """Rows of this rank's episodes, with the advantages of whole groups.

        Args:
            episodes: this rank's; ranks hold equally many, in the order of the global batch (a group may span ranks).
            gather: returns of all ranks are needed, and their numbers of trained tokens.
        """
        outcomes: list[Outcome] = gather([self.outcome(e) for e in episodes])
        advantages, writes = self.advantages(outcomes), self.write_advantages(outcomes)
        signal = [
            any(_nonzero(advantages[i]) or any((writes[i] or {}).values()) for i in group)
            for group in self._groups(len(outcomes))
        ]
        rows: list[Row] = []
        for i, episode in enumerate(episodes):
            place = rank * len(episodes) + i
            advantage = advantages[place]
            masked = self.overlong == "mask" and outcomes[place].overlong
            skipped = self.skip_zero_variance and not signal[place // self.group]
            if advantage is not None and not masked and not skipped:
                sequences = build_sequences(episode.trajectory, self.train)
                rows += [Row(s, self._per_token(s, advantage, writes[place]), i) for s in sequences]
        if self.normalize == "rollout":
            rows = per_rollout(rows, gather)
        metrics = _metrics(outcomes, signal, rows, len(episodes)) | _write_metrics(outcomes, writes)
        return Credited(rows, metrics)

    def write_advantages(self, outcomes: Sequence[Outcome]) -> list[Advantages | None]:
        """Per rollout what its writes earn, by step; `None` where they earn what every other token does."""
        spec = estimator(self.estimator)
        values = grpo if spec.per_step else spec.function  # estimators per step score no whole episode
        paired = [Paired(math.fsum(o.rewards or ()) if self._counts(o) else None, o.beside) for o in outcomes]
        groups = ([paired[i] for i in group] for group in self._groups(len(outcomes)))
        return [earned for group in groups for earned in self.writes.advantages(group, values)]

    def _groups(self, episodes: int) -> list[range]:
        return [range(start, start + self.group) for start in range(0, episodes, self.group)]

    def _per_token(
        self, sequence: TokenSequence, advantage: float | list[float], writes: Advantages | None
    ) -> Advantage:
        """The episode's number or each trained token's step value; tokens of a write earn what the write does."""
        earned = writes or {}
        wrote = {c for c, path in sequence.paths.items() if writes is not None and self.writes.is_write(path)}
        if isinstance(advantage, float) and not wrote:
            return advantage

        def value(step: int, call: int, trained: int) -> float:
            if not trained:
                return 0.0
            if call in wrote:
                return earned.get(step, earned.get(EVERY, 0.0))
            return advantage if isinstance(advantage, float) else advantage[step]

        return tuple(map(value, sequence.steps, sequence.calls, sequence.mask))

    def _counts(self, outcome: Outcome) -> bool:
        return outcome.rewards is not None and not (self.overlong == "drop" and outcome.overlong)


def is_overlong(trajectory: Trajectory, ends: Sequence[str]) -> bool:
    """Whether the episode ended for a reason in `ends`."""
    ended = str(trajectory.metrics.get("ended", "environment"))
    cut = bool(trajectory.transitions) and trajectory.transitions[-1].truncated
    return ended in ends or ("truncated" in ends and cut)


def per_rollout(rows: Sequence[Row], gather: Gather = list) -> list[Row]:
    """Scale advantages so that every rollout has the same weight, however many tokens its scaffold trained.

    The loss divides by all N trained tokens; a rollout with n of them counts n / N. With the factor N / (R n), R
    rollouts with something to train, it counts 1 / R: the mean over rollouts of their mean over tokens.
    """
    counts: Counter[int] = Counter()
    for row in rows:
        counts[row.episode] += row.sequence.trained
    everywhere: list[int] = gather(list(counts.values()))
    total, rollouts = sum(everywhere), len(everywhere)
    return [replace(row, advantage=_times(row.advantage, total / (rollouts * counts[row.episode]))) for row in rows]


def _times(advantage: Advantage, factor: float) -> Advantage:
    return advantage * factor if isinstance(advantage, float) else tuple(a * factor for a in advantage)


def _nonzero(advantage: float | list[float] | None) -> bool:
    return any(advantage) if isinstance(advantage, list) else bool(advantage)


def _metrics(
    outcomes: Sequence[Outcome], signal: Sequence[bool], rows: Sequence[Row], episodes: int
) -> dict[str, float]:
    per_episode = Counter(row.episode for row in rows)
    return {
        "groups/zero_variance": 1 - _share(signal),
        "rollouts/unscorable": _share([o.rewards is None for o in outcomes]),
        "rollouts/overlong": _share([o.overlong for o in outcomes]),
        "rollouts/rows_per_episode": len(rows) / max(1, episodes),
        "rollouts/trained_tokens": float(sum(row.sequence.trained for row in rows)),
        "rollouts/multi_row_episodes": sum(n > 1 for n in per_episode.values()) / max(1, episodes),
    }


def _write_metrics(outcomes: Sequence[Outcome], writes: Sequence[Advantages | None]) -> dict[str, float]:
    """What the writes of the round were worth; nothing where they earn what every other token does."""
    if all(w is None for w in writes):
        return {}
    beside = [r for o in outcomes for r in o.beside]
    earned = [value for w in writes for value in (w or {}).values()]
    return {
        "writes/counterfactuals": float(len(beside)),
        "writes/failed": _share([r.total is None for r in beside]),
        "writes/advantage_mean": math.fsum(earned) / max(1, len(earned)),
        "writes/with_signal": _share([value != 0 for value in earned]),
    }


def _share(flags: Sequence[bool]) -> float:
    return sum(flags) / max(1, len(flags))
