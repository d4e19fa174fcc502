"""Figures of an episode: what each is called, in which unit, and whether more is better.

An environment declares the figures it reports in its class's `metadata` (see `agentspec.envs.contract`); the scaffold
adds its own (`SCAFFOLD`: steps, tokens, calls, cost). Evaluation, validation, training logs and the command line read
these declarations, so no name of an environment's figure stands outside the environment.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agentspec.trajectory import Trajectory

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Metric:
    """A figure of an episode.

    Args:
        name: its key in `info["metrics"]`, in rows and in logs.
        unit: as it is printed (`$/h`, `steps`); empty for plain numbers and shares.
        heading: in tables; default: the name in words, with the unit in brackets.
        digits: after the point, in tables.
        higher_is_better: `False` for costs and times.
        summary: one line for documentation.
    """

    name: str
    unit: str = ""
    heading: str = ""
    digits: int = 2
    higher_is_better: bool = True
    summary: str = ""

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"a metric is called {self.name!r}; expected a name of letters, digits and underscores")
        if not self.heading:
            unit = f" ({self.unit})" if self.unit else ""
            object.__setattr__(self, "heading", self.name.replace("_", " ") + unit)

    def show(self, value: float) -> str:
        """`value` with the metric's digits."""
        return f"{value:.{self.digits}f}"


SUCCESS = Metric("success", summary="whether the task was achieved (0 or 1)")
"""For environments whose episodes succeed or fail; the name is known to reflection and search."""

SCAFFOLD: tuple[Metric, ...] = (
    Metric("return", summary="sum of the environment's rewards"),
    Metric("steps", digits=1, higher_is_better=False),
    Metric("invalid_share", heading="invalid", digits=3, higher_is_better=False),
    Metric("input_tokens_per_step", heading="input tokens/step", digits=0, higher_is_better=False),
    Metric("output_tokens_per_step", heading="output tokens/step", digits=1, higher_is_better=False),
    Metric("calls_per_step", heading="calls/step", higher_is_better=False),
    Metric("thinking_s_per_step", heading="thinking (s/step)", digits=3, higher_is_better=False),
    Metric("cost", "$", digits=4, higher_is_better=False),
)
"""What the scaffold measures in every environment, in the order of tables."""

LOGGED = ("return", "steps", "invalid_actions", "llm_calls", "input_tokens", "output_tokens")
"""Totals of the scaffold that training and validation log per episode, beside what the environment declares."""

PLAIN = {metric.name: metric for metric in (SUCCESS, *SCAFFOLD)}
CUT_SHORT = ("budget", "context")
"""Ends of an episode that the scaffold brought about, not the environment: counted beside the means."""

_ROW = frozenset({"seed", "rollout", "input_tokens", "output_tokens", "thinking_s", "wall_s"})
"""Numbers of a row that are no metrics."""

_COUNTED = ("invalid_actions", "llm_calls", "cached_tokens", "input_tokens", "output_tokens", "thinking_s", "ended")


def declared(env: str) -> tuple[Metric, ...]:
    """The figures that an environment declares, its primary one first.

    `env` is a registered name or gymnasium id. Empty for an environment that is not registered (any more), or that
    declares nothing; rows and trajectories of such environments can still be read.
    """
    return tuple(_metadata(env).get("metrics", ()))


def typical_return(env: str) -> float:
    """The declared size of a good episode's return (above 0), by which rewards of different worlds are compared.

    Methods that need values near the unit interval (tree searches, say) divide returns by it. 1.0 where nothing is
    declared.
    """
    return float(_metadata(env).get("typical_return", 1.0))


def _metadata(env: str) -> Mapping[str, Any]:
    from agentspec.envs.making import environment_class

    return getattr(environment_class(env), "metadata", None) or {}


def columns(rows: Iterable[Row]) -> tuple[Metric, ...]:
    """The metrics of `rows`, in the order of tables: what their environments declare, success, then the scaffold's.

    Only those that at least one row has a number for. Rows of an environment that is not registered here keep their
    figures, under plain names.
    """
    rows = list(rows)
    found: dict[str, Metric] = {}
    for env in dict.fromkeys(str(row.get("env", "")) for row in rows):
        stated = declared(env) or _recorded([row for row in rows if row.get("env") == env])
        found |= {metric.name: metric for metric in stated if metric.name not in found}
    known = {**found, **{name: metric for name, metric in PLAIN.items() if name not in found}}
    return tuple(m for m in known.values() if any(row.get(m.name) is not None for row in rows))


def _recorded(rows: Iterable[Row]) -> tuple[Metric, ...]:
    """Metrics by the names that rows have numbers under and that are not the scaffold's."""
    names = dict.fromkeys(
        name for row in rows for name, value in row.items() if name not in _ROW and number(value) is not None
    )
    return tuple(Metric(name) for name in names if name not in PLAIN and name.isidentifier())


def primary_metric(rows: Iterable[Row]) -> Metric:
    """The first of `columns`; the return where no row has any number."""
    return next(iter(columns(rows)), PLAIN["return"])


def figures(trajectory: Trajectory) -> dict[str, float]:
    """The numbers of an episode that are worth a mean: what its environment declares, then `LOGGED`."""
    names = dict.fromkeys((*(m.name for m in declared(trajectory.task.env)), "success", *LOGGED))
    values = {name: number(trajectory.metrics.get(name)) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def means(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each number over the rows that have it, in the order in which they appear."""
    found: dict[str, list[float]] = {}
    for row in rows:
        for name, value in row.items():
            found.setdefault(name, []).append(value)
    return {name: math.fsum(values) / len(values) for name, values in found.items()}


def episode_row(trajectory: Trajectory) -> dict[str, Any]:
    """One episode as a flat row of JSON values.

    What the environment declares stands under its own names, all else it reports under `env_metrics`. A number that
    was not reported is `None`; a failed episode has no numbers at all, and its error. `thinking_s_per_step` is
    wall-clock time of the model calls, in seconds.
    """
    from agentspec.trajectory import jsonable

    task, m = trajectory.task, trajectory.metrics
    row: dict[str, Any] = {
        "env": task.env,
        "task": task.key,
        "seed": task.seed,
        "options": jsonable(task.options),
        "rollout": trajectory.rollout,
        "status": trajectory.status,
        "error": trajectory.error,
        "ended": m.get("ended", ""),
    }
    names = dict.fromkeys([*(metric.name for metric in declared(task.env)), *PLAIN])
    if not trajectory.scorable:
        return row | dict.fromkeys(names)
    steps = number(m.get("steps")) or 0.0
    row |= {name: number(m.get(name)) for name in names}
    row |= {
        "steps": int(steps),
        "invalid_share": _per(m.get("invalid_actions"), steps),
        "input_tokens_per_step": _per(m.get("input_tokens"), steps),
        "output_tokens_per_step": _per(m.get("output_tokens"), steps),
        "calls_per_step": _per(m.get("llm_calls"), steps),
        "thinking_s_per_step": _per(m.get("thinking_s"), steps),
        "input_tokens": m.get("input_tokens"),
        "output_tokens": m.get("output_tokens"),
        "thinking_s": m.get("thinking_s"),
    }
    own = {k: jsonable(v) for k, v in m.items() if k not in row and k not in _COUNTED}
    return row | {"env_metrics": own}


def outcome(trajectory: Trajectory) -> dict[str, Any]:
    """What `agentspec run --json` ends with: the environment's declared figures, success where reported, return, steps.

    Values as the environment reported them; `None` where there is no number, and in a failed episode.
    """
    reported = trajectory.metrics if trajectory.scorable else {}
    names = [m.name for m in declared(trajectory.task.env)]
    if number(reported.get("success")) is not None:
        names.append("success")
    values = {name: reported.get(name) for name in dict.fromkeys([*names, "return", "steps"])}
    return {name: None if number(value) is None else value for name, value in values.items()}


def number(value: Any) -> float | None:
    """`value` as a finite float (booleans as 0 and 1), or `None`."""
    if not isinstance(value, (bool, int, float)) or not math.isfinite(value):
        return None
    return float(value)


def _per(total: Any, steps: float) -> float | None:
    value = number(total)
    return None if value is None or steps == 0 else value / steps
