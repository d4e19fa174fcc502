"""Two episodes of one task side by side, as one page that opens from disk (`agentspec compare A B --to page.html`).

What a log viewer does not show: where the two part, both routes on one map, money and battery over time, and what was
sampled token by token, coloured by the advantage that it was trained towards.
"""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agentspec.records.folder import UPDATES
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, read_trajectories
from agentspec.types import Completion, LLMCall, Transition
from eval.decoding import decoder_of, prompt_text
from eval.inspect_logs import advantages_of, pictures_of
from eval.report import figures
from eval.report.blocks import STYLE

GAUGES = ("balance", "battery", "energy", "goal_conditions", "distance_left")
"""Figures of a step that are drawn over its number, where a world reports them."""

CSS = """
body { max-width: 90rem; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem; border-top: 1px solid #ccc; padding: 0.5rem 0; }
.pair.parted { border-top: 3px solid #D55E00; }
.side { min-width: 0; }
.drawings { display: grid; grid-template-columns: repeat(auto-fit, minmax(22rem, 1fr)); gap: 1rem; }
.did { font-weight: 600; } .bad { color: #a33; } .reward { color: #00664b; }
pre { white-space: pre-wrap; overflow-wrap: anywhere; font-size: 0.78rem; background: #f6f6f6; padding: 0.5rem;
  margin: 0.3rem 0; }
.token { border-radius: 2px; } .forced { color: #888; }
summary { cursor: pointer; font-size: 0.85rem; color: #444; }
img.step { max-width: 160px; image-rendering: pixelated; }
"""


@dataclass(frozen=True)
class Side:
    """One of the two.

    Args:
        name: what it is called on the page.
        advantage: what its trained tokens were trained towards; `None` outside training.
    """

    name: str
    trajectory: Trajectory
    advantage: float | None = None
    pictures: Mapping[int, str] | None = None


def read_side(text: str, task: str = "", *, pictures: bool = True) -> Side:
    """`[NAME=]FILE[#N]`: the N-th episode of a file of trajectories (from 0), or the one of `task`.

    Raises:
        SpecError: no such file or episode.
    """
    name, equals, rest = text.partition("=")
    place = rest if equals and not Path(text.partition("#")[0]).is_file() else text
    file, _, number = place.partition("#")
    path = Path(file)
    if not path.is_file():
        raise SpecError(f"there is no file {path}; give [NAME=]FILE[#N] with a file of trajectories")
    try:
        episodes = list(read_trajectories(path))
    except ValueError as error:
        raise SpecError(str(error)) from error
    if number and (not number.isdigit() or int(number) >= len(episodes)):
        raise SpecError(f"{path} holds {len(episodes)} episodes, numbered from 0; there is no episode {number}")
    same = [t for t in episodes if t.task.key == task]
    trajectory = episodes[int(number)] if number else (same or episodes)[0]
    label = name if place == rest else trajectory.policy or path.stem
    run = next((folder for folder in path.parents if (folder / UPDATES).is_file()), path.parent)
    advantage = advantages_of(run).get(trajectory.episode)
    if isinstance(advantage, list):
        advantage = math.fsum(advantage) / len(advantage) if advantage else None
    return Side(label, trajectory, advantage, pictures_of(trajectory) if pictures else None)


def compare_page(a: Side, b: Side) -> str:
    """The page.

    Raises:
        SpecError: the episodes are of different tasks.
    """
    first, second = a.trajectory.task, b.trajectory.task
    if first.key != second.key:
        raise SpecError(
            f"these are episodes of different tasks: {first.env} seed {first.seed} {dict(first.options)} and "
            f"{second.env} seed {second.seed} {dict(second.options)}; compare two of the same"
        )
    title = f"{a.name} and {b.name}: {first.env}, seed {first.seed}"
    split = parting(a.trajectory, b.trajectory)
    where = f"They part at step {split}." if split is not None else "They are the same, step by step."
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        f"<p>{where} Advantages: {_advantage(a)}, {_advantage(b)}.</p>",
        _end(a, b),
        *_drawings(a, b),
        "<h2>Step by step</h2>",
        f'<div class="pair">{"".join(f"<h3 class=side>{html.escape(s.name)}</h3>" for s in (a, b))}</div>',
    ]
    rows = itertools.zip_longest(a.trajectory.transitions, b.trajectory.transitions)
    for i, (left, right) in enumerate(rows):
        mark = " parted" if i == split else ""
        parts.append(f'<div class="pair{mark}" id="step-{i}">{_step(a, left)}{_step(b, right)}</div>')
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}{CSS}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def parting(a: Trajectory, b: Trajectory) -> int | None:
    """The first step at which what was done, or what was seen before it, differs; `None` if there is none."""
    for i, (left, right) in enumerate(itertools.zip_longest(a.transitions, b.transitions)):
        if (
            left is None
            or right is None
            or (left.action_text, left.input.text) != (right.action_text, right.input.text)
        ):
            return i
    return None


def _advantage(side: Side) -> str:
    shown = "not trained on" if side.advantage is None else f"{side.advantage:+.3f}"
    return f"{html.escape(side.name)} {shown}"


def _end(a: Side, b: Side) -> str:
    """The figures of both at the end."""
    names = [
        n
        for n in dict.fromkeys([*a.trajectory.metrics, *b.trajectory.metrics])
        if any(isinstance(s.trajectory.metrics.get(n), int | float | str) for s in (a, b))
    ]
    cells = {n: "".join(f"<td>{_number(s.trajectory.metrics.get(n))}</td>" for s in (a, b)) for n in names}
    body = "".join(f"<tr><td>{html.escape(n)}</td>{numbers}</tr>" for n, numbers in cells.items())
    head = f"<tr><th></th><th>{html.escape(a.name)}</th><th>{html.escape(b.name)}</th></tr>"
    return f"<details><summary>Figures at the end</summary><table>{head}{body}</table></details>"


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value)) if value is not None else "–"


def _drawings(a: Side, b: Side) -> list[str]:
    drawn = []
    routes = {s.name: route(s.trajectory) for s in (a, b)}
    if all(len(points) > 1 for points in routes.values()):
        drawn.append(figures.routes("routes", routes, caption="Routes; a ring marks the start, a square the end."))
    for gauge in GAUGES:
        series = {s.name: [_gauge(s.trajectory, gauge)] for s in (a, b)}
        if all(len(points[0]) > 1 for points in series.values()) and any(
            len({y for _, y in points[0]}) > 1 for points in series.values()
        ):
            label = gauge.replace("_", " ")
            drawn.append(
                figures.curves(
                    gauge, series, x="step", y=label, caption=f"{label}, as the agent sees it before each step."
                )
            )
    shown = (
        f"<figure>{f.svg[f.svg.index('<svg') :]}<figcaption>{html.escape(f.caption)}</figcaption></figure>"
        for f in drawn
    )
    return ['<div class="drawings">', *shown, "</div>"] if drawn else []


def route(trajectory: Trajectory) -> list[tuple[float, float]]:
    """Where the agent stood before each step, in the world's own coordinates; empty where it does not say."""
    found = []
    for t in trajectory.transitions:
        state = t.input.state
        if isinstance(state.get("position"), list | tuple) and len(state["position"]) >= 2:
            found.append((float(state["position"][0]), float(state["position"][1])))
        elif isinstance(state.get("x"), int | float) and isinstance(state.get("z"), int | float):
            found.append((float(state["x"]), float(state["z"])))
    return found


def _gauge(trajectory: Trajectory, name: str) -> list[tuple[float, float]]:
    found = []
    for t in trajectory.transitions:
        value = t.input.state.get(name, t.info.get(name))
        if isinstance(value, int | float) and not isinstance(value, bool):
            found.append((float(t.step), float(value)))
    return found


def _step(side: Side, t: Transition | None) -> str:
    if t is None:
        return '<div class="side">(ended)</div>'
    calls = [call for call in side.trajectory.calls if call.tag.step == t.step]
    outcome = str(t.info.get("error") or t.info.get("message") or "")
    bad = " bad" if t.info.get("error") or not t.decision.valid else ""
    reward = f' <span class="reward">{t.reward:+.2f}</span>' if t.reward else ""
    picture = (side.pictures or {}).get(t.step)
    image = f'<img class="step" alt="what is seen at step {t.step}" src="{picture}">' if picture else ""
    parts = [
        f'<div class="did">{t.step}: {html.escape(t.action_text)}{reward}</div>',
        f'<div class="outcome{bad}">{html.escape(outcome)}</div>' if outcome else "",
        image,
        f"<details><summary>what it saw</summary><pre>{html.escape(t.input.text)}</pre></details>",
        *(_call(call, side.advantage) for call in calls),
    ]
    return f'<div class="side">{"".join(parts)}</div>'


def _call(call: LLMCall, advantage: float | None) -> str:
    prompt = prompt_text(call)
    shown = f"<details><summary>prompt</summary><pre>{html.escape(prompt)}</pre></details>" if prompt else ""
    answers = "".join(f"<pre>{_tokens(call, c, advantage)}</pre>" for c in call.completions)
    usage = f"{call.usage.input_tokens} + {call.usage.output_tokens} tokens"
    what = f"{html.escape(call.tag.path)}, {usage}"
    return f"<details open><summary>{what}</summary>{shown}{answers}</details>"


def _tokens(call: LLMCall, completion: Completion, advantage: float | None) -> str:
    """The answer, token by token: trained ones coloured by the advantage, forced ones grey."""
    decode = decoder_of(call.model)
    if decode is None or not completion.token_ids:
        return html.escape(completion.text)
    trained = advantage is not None and completion.credit == "executed"
    parts = []
    for i, token in enumerate(completion.token_ids):
        allowed = completion.allowed[i] if i < len(completion.allowed) else None
        forced = allowed is not None and len(allowed) == 1
        logprob = completion.logprobs[i] if i < len(completion.logprobs) else math.nan
        colour = f' style="background:{shade(advantage)}"' if trained and not forced and advantage is not None else ""
        kind = "token forced" if forced else "token"
        title = "forced" if forced else f"log-probability {logprob:.3f}"
        parts.append(f'<span class="{kind}" title="{title}"{colour}>{html.escape(decode([token]))}</span>')
    return "".join(parts)


def shade(advantage: float) -> str:
    """Blue for above the group, orange for below, stronger the further (full from 2 on).

    >>> shade(2.0), shade(-1.0)
    ('rgba(0,114,178,0.50)', 'rgba(213,94,0,0.25)')
    """
    strength = min(1.0, abs(advantage) / 2) * 0.5
    red, green, blue = (0, 114, 178) if advantage >= 0 else (213, 94, 0)
    return f"rgba({red},{green},{blue},{strength:.2f})"


def write_comparison(a: str, b: str, path: str | Path, *, pictures: bool = True) -> Path:
    """Read two episodes and write the page; the second is by default the one of the first's task."""
    from agentspec.files import write_atomic

    left = read_side(a, pictures=pictures)
    right = read_side(b, left.trajectory.task.key, pictures=pictures)
    if left.name == right.name:
        left, right = Side(f"{left.name} (1)", *_rest(left)), Side(f"{right.name} (2)", *_rest(right))
    write_atomic(path, compare_page(left, right))
    return Path(path)


def _rest(side: Side) -> Sequence[Any]:
    return side.trajectory, side.advantage, side.pictures
