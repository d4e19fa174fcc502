"""Evaluation while training: held-out tasks under the training scaffold and, by choice, under others.

Tasks come from the validation split, which neither training nor the final evaluation sees: the best checkpoint is
chosen on them. Every rank plays its share of the tasks; all ranks get the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from accelerate.utils import gather_object

from agentspec.episode import Job
from agentspec.metrics import figures, means
from agentspec.spec import AgentSpec
from trainers.config import ScaffoldConfig
from trainers.credit import ScoredEpisode
from trainers.mixin import Base
from trainers.rollouts import starting_states, task_of


def validation_scaffolds(config: ScaffoldConfig) -> dict[str, AgentSpec]:
    """Scaffold by prefix of its metrics: the training scaffold has none, others `LABEL/`; greedy by default."""
    training = config.spec
    scaffolds = {"": training} | {f"{s.label}/": s for s in config.other_specs if s != training}
    changes = config.evaluation_sampling
    return {prefix: replace(s, sampling=replace(s.sampling, **changes)) for prefix, s in scaffolds.items()}


def validate(
    scaffolds: Mapping[str, AgentSpec],
    jobs: Sequence[Job],
    play: Callable[[AgentSpec, Sequence[Job]], Sequence[ScoredEpisode]],
    *,
    rank: int = 0,
    ranks: int = 1,
    gather: Callable[[list[Any]], list[Any]] = list,
) -> dict[str, float]:
    """Mean figures per scaffold over the same tasks.

    Args:
        scaffolds: by prefix, as of `validation_scaffolds`.
        jobs: all of them; rank r plays those at r, r + ranks, ...
        play: scaffold, jobs -> episodes, scored by the training reward.
        gather: list of this rank -> concatenated lists of all ranks.

    Returns:
        `PREFIXreward` (the training reward per episode), the figures that the environment declares and the scaffold's
        (`agentspec.metrics.figures`), and `PREFIXunscorable`, the share of episodes that failed; means leave these
        out. `reward` is NaN if all failed.
    """
    metrics: dict[str, float] = {}
    for prefix, spec in scaffolds.items():
        rows = gather([_numbers(episode) for episode in play(spec, jobs[rank::ranks])])
        scored = [row for row in rows if row is not None]
        found = {"reward": math.nan} | means(scored) | {"unscorable": 1 - len(scored) / len(rows)}
        metrics |= {f"{prefix}{name}": value for name, value in found.items()}
    return metrics


def _numbers(episode: ScoredEpisode) -> dict[str, float] | None:
    """Numbers of one episode; `None` if it failed."""
    return None if episode.score is None else figures(episode.trajectory) | {"reward": episode.score.total}


class Validation(Base):
    """Evaluates by playing; mixed into the trainer."""

    def evaluate(
        self, eval_dataset: Any = None, ignore_keys: Any = None, metric_key_prefix: str = "eval"
    ) -> dict[str, float]:
        """Play the validation tasks (rows of `trainers.rollouts.task_rows`) with the policy as it is.

        The trainer's random states, its buffers and the run's memory stay as they are: training goes on as if nothing
        had been evaluated.
        """
        rows = self.eval_dataset if eval_dataset is None else eval_dataset
        tasks = [task_of(row) for row in rows]
        states = starting_states(tasks, self._memory, unseen=True)
        training = self.model.training
        self.model.eval()
        with self._current_weights():
            metrics = validate(
                validation_scaffolds(self.args),
                [Job(t, 0, self.args.seed, s) for t, s in zip(tasks, states, strict=True)],
                lambda spec, jobs: self._play(jobs, spec),
                rank=self.accelerator.process_index,
                ranks=self.accelerator.num_processes,
                gather=gather_object,
            )
        metrics = {f"{metric_key_prefix}_{name}": value for name, value in metrics.items()}
        self.log(dict(metrics))
        control = self.callback_handler.on_evaluate(self.args, self.state, self.control, metrics)  # type: ignore[has-type]
        self.control = control
        self.model.train(training)
        return metrics
