"""What a user sees while a run goes on: one line per update, the reward curve so far, and a sample of a rollout."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any, TextIO

from transformers import ProgressCallback, TrainerCallback

from agentspec.trajectory import Trajectory

BARS = "▁▂▃▄▅▆▇█"


def sparkline(values: Sequence[float], width: int = 40) -> str:
    """The last `width` values as bars, scaled between their least and greatest.

    >>> sparkline([0, 1, 2, 3.5])
    '▁▃▅█'
    """
    shown = list(values)[-width:]
    if not shown:
        return ""
    low, high = min(shown), max(shown)
    span = (high - low) or 1.0
    return "".join(BARS[min(len(BARS) - 1, int((v - low) / span * len(BARS)))] for v in shown)


def episode_lines(trajectory: Trajectory, most: int = 8) -> list[str]:
    """The first steps of an episode, one line each."""
    lines = [f"    {t.step + 1:>3}  {t.action_text[:60]:<60} {t.reward:+.2f}" for t in trajectory.transitions[:most]]
    rest = len(trajectory.transitions) - most
    return [*lines, f"         ... {rest} more steps"] if rest > 0 else lines


class Bar(ProgressCallback):
    """The progress bar without the dictionary that transformers prints with every log: a report says it in a line."""

    def on_log(self, args: Any, state: Any, control: Any, logs: Any = None, **_: Any) -> None:
        """Nothing."""


class TerminalReport(TrainerCallback):
    """Prints after every logged update; every `sample_every` updates also a rollout.

    Args:
        episodes: gives the episodes of the last generation round.
    """

    def __init__(
        self,
        episodes: Callable[[], Sequence[Trajectory]],
        sample_every: int = 5,
        stream: TextIO | None = None,
    ) -> None:
        self.episodes = episodes
        self.sample_every = sample_every
        self.stream = stream or sys.stderr
        self.rewards: list[float] = []

    def on_log(self, args: Any, state: Any, control: Any, logs: dict[str, Any] | None = None, **_: Any) -> None:
        if not state.is_world_process_zero or not logs or "reward" not in logs or logs["reward"] is None:
            return
        self.rewards.append(float(logs["reward"]))
        line = (
            f"step {state.global_step:>4}/{state.max_steps}  reward {self.rewards[-1]:+7.3f} "
            f"(sd {float(logs.get('reward_std') or 0):.3f})  {sparkline(self.rewards)}  "
            f"rows/episode {float(logs.get('rollouts/rows_per_episode') or 0):.1f}  "
            f"logp diff {float(logs.get('sampling/logp_difference_max') or 0):.1e}"
        )
        print(f"\n{line}", file=self.stream, flush=True)
        if self.sample_every and len(self.rewards) % self.sample_every == 1 % self.sample_every:
            self._sample()

    def on_evaluate(self, args: Any, state: Any, control: Any, metrics: dict[str, float], **_: Any) -> None:
        """One line per scaffold that was validated."""
        if not state.is_world_process_zero:
            return
        for name, value in metrics.items():
            prefix, found, _rest = name.partition("reward")
            if found and not _rest:
                scaffold = prefix.removeprefix("eval_").rstrip("/") or "training scaffold"
                print(f"  held-out tasks, {scaffold}: reward {value:+.3f}", file=self.stream, flush=True)

    def _sample(self) -> None:
        scored = [t for t in self.episodes() if t.scorable]
        if scored:
            best = max(scored, key=lambda t: float(t.metrics.get("return", 0.0)))
            print(f"  best rollout of this update ({best.metrics.get('return', 0.0):+.2f}):", file=self.stream)
            print("\n".join(episode_lines(best)), file=self.stream, flush=True)
