"""What a user sees while a run goes on: one line per update, the reward curve so far, and a sample of a rollout."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from transformers import ProgressCallback, TrainerCallback

from agentspec.trajectory import Trajectory

BARS = "▁▂▃▄▅▆▇█"
SAMPLE_EVERY, STEPS_SHOWN = 5, 8


def sparkline(values: Sequence[float], width: int = 40) -> str:
    """The last `width` values as bars, scaled between their least and greatest.

    >>> sparkline([0, 1, 2, 3.5])
    '▁▃▅█'
    """
    shown = list(values)[-width:]
    low, high = min(shown, default=0.0), max(shown, default=0.0)
    span = (high - low) or 1.0
    return "".join(BARS[min(len(BARS) - 1, int((v - low) / span * len(BARS)))] for v in shown)


class Bar(ProgressCallback):
    """The progress bar without the dictionary that transformers prints with every log: a report says it in a line."""

    def on_log(self, args: Any, state: Any, control: Any, logs: Any = None, **_: Any) -> None:
        """Nothing."""


class TerminalReport(TrainerCallback):
    """Prints after every logged update; every `SAMPLE_EVERY` updates also a rollout.

    Args:
        episodes: gives the episodes of the last generation round.
    """

    def __init__(self, episodes: Callable[[], Sequence[Trajectory]]) -> None:
        self.episodes = episodes
        self.rewards: list[float] = []

    def on_log(self, args: Any, state: Any, control: Any, logs: dict[str, Any] | None = None, **_: Any) -> None:
        if not state.is_world_process_zero or not logs or logs.get("reward") is None:
            return
        self.rewards.append(float(logs["reward"]))
        deviation, rows, difference = (
            float(logs.get(name) or 0)
            for name in ("reward_std", "rollouts/rows_per_episode", "sampling/logp_difference_max")
        )
        _say(
            f"\nstep {state.global_step:>4}/{state.max_steps}  reward {self.rewards[-1]:+7.3f} (sd {deviation:.3f})  "
            f"{sparkline(self.rewards)}  rows/episode {rows:.1f}  logp diff {difference:.1e}"
        )
        scored = [t for t in self.episodes() if t.scorable] if len(self.rewards) % SAMPLE_EVERY == 1 else []
        if scored:
            _sample(max(scored, key=lambda t: float(t.metrics.get("return", 0.0))))

    def on_evaluate(self, args: Any, state: Any, control: Any, metrics: dict[str, float], **_: Any) -> None:
        """One line per scaffold that was validated."""
        for name, value in metrics.items() if state.is_world_process_zero else ():
            if name.endswith("reward"):
                scaffold = name.removesuffix("reward").removeprefix("eval_").rstrip("/") or "training scaffold"
                _say(f"  held-out tasks, {scaffold}: reward {value:+.3f}")


def _sample(best: Trajectory) -> None:
    """The first steps of an episode, one line each."""
    _say(f"  best rollout of this update ({best.metrics.get('return', 0.0):+.2f}):")
    for t in best.transitions[:STEPS_SHOWN]:
        _say(f"    {t.step + 1:>3}  {t.action_text[:60]:<60} {t.reward:+.2f}")
    if (rest := len(best.transitions) - STEPS_SHOWN) > 0:
        _say(f"         ... {rest} more steps")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
