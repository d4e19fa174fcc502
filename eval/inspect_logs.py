"""Episodes as Inspect AI logs, for its viewer (`pip install 'agentspec-rl[inspect]'`).

One log per cell (policy, training run and scaffold, on one set of tasks), one sample per task, its epochs are the
repeats. A sample's transcript has a span per step, in it a span per module that called the model, the calls as model
events with their cost and what was credited, what memory recalled and what the environment answered as info events.
Everything goes through Inspect's own API, so its viewer and its analysis tools read it.

A trajectory has no clock times; events stand at the model's latencies after the time at which the file was written.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from agentspec.files import digest, read_lines
from agentspec.metrics import primary_metric
from agentspec.records.folder import UPDATES
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, read_trajectories
from eval.inspect_events import events, plain, usage_of
from eval.naming import slug

Row = Mapping[str, Any]
Advantages = Mapping[str, Any]
"""Episode id -> advantage of its trained tokens (a number, or one per step)."""

PICTURE = 160
"""Longer side of a picture, in pixels."""


def export_inspect(source: str | Path, folder: str | Path, *, pictures: bool = False) -> list[Path]:
    """Write logs.

    Args:
        source: folder of an evaluation with kept trajectories, folder of a training run, or a file of trajectories.
        folder: where the `.eval` files go.
        pictures: play episodes again and show what the environment renders, small.

    Returns:
        the files.

    Raises:
        SpecError: Inspect is not installed, or there are no trajectories.
    """
    try:
        from inspect_ai.log import write_eval_log
    except ImportError:
        raise SpecError("export to Inspect needs it: pip install 'agentspec-rl[inspect]'") from None
    written = []
    for name, rows, episodes, when in _cells(Path(source)):
        log = _log(name, rows, episodes, when, advantages_of(Path(source)), pictures=pictures)
        path = Path(folder) / f"{'_'.join(map(slug, filter(None, name)))}.eval"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_eval_log(log, str(path))
        written.append(path)
    return written


Named = tuple[str, ...]


def _cells(source: Path) -> Iterator[tuple[Named, list[Row], list[Trajectory], datetime]]:
    """Name, rows and trajectories of each cell."""
    results = source / "results.jsonl" if source.is_dir() else source
    if results.name == "results.jsonl" and results.is_file():
        yield from _evaluated(results)
        return
    files = sorted((source / "trajectories").rglob("*.jsonl")) if source.is_dir() else [source]
    if not files or not files[0].is_file():
        raise SpecError(f"{source} has neither results.jsonl nor trajectories; give an evaluation, a run, or a file")
    for path in files:
        try:
            episodes = list(read_trajectories(path))
        except ValueError as error:
            raise SpecError(str(error)) from error
        if episodes:
            yield (path.parent.name, path.stem), [{} for _ in episodes], episodes, _written(path)


def _evaluated(results: Path) -> Iterator[tuple[Named, list[Row], list[Trajectory], datetime]]:
    kept = [row for row in read_lines(results) if row.get("trajectory")]
    if not kept:
        raise SpecError(f"{results} names no trajectories; evaluate with --trajectories (`trajectories: true`)")
    names = dict.fromkeys((r["tasks"], r["policy"], r.get("run", ""), r["scaffold"]) for r in kept)
    for tasks, policy, run, scaffold in names:
        rows: list[Row] = [
            r
            for r in kept
            if (r["tasks"], r["policy"], r.get("run", ""), r["scaffold"]) == (tasks, policy, run, scaffold)
        ]
        episodes = [next(read_trajectories(results.parent / row["trajectory"])) for row in rows]
        yield (tasks, policy, run, scaffold), rows, episodes, _written(results)


def _written(path: Path) -> datetime:
    return datetime.fromtimestamp(path.stat().st_mtime, UTC)


def advantages_of(source: Path) -> Advantages:
    """From the receipts of a training run: what each episode's tokens were trained towards."""
    path = source / UPDATES
    if not source.is_dir() or not path.is_file():
        return {}
    found: dict[str, Any] = {}
    for receipt in read_lines(path):
        names = receipt.get("episodes", [])
        for row in receipt.get("rows", []):
            found.setdefault(names[row["episode"]], row["advantage"])
    return found


def _log(
    name: Named,
    rows: Sequence[Row],
    episodes: Sequence[Trajectory],
    when: datetime,
    advantages: Advantages,
    *,
    pictures: bool,
) -> Any:
    from inspect_ai.log import EvalConfig, EvalDataset, EvalLog, EvalSpec

    tasks = list(dict.fromkeys(t.task.key for t in episodes))
    epochs = max(t.rollout for t in episodes) + 1
    models = [call.model for t in episodes for call in t.calls if call.model]
    samples = [_sample(t, when, advantages, pictures) for t in episodes]
    spec = EvalSpec(
        created=when.isoformat(timespec="seconds"),
        task=" / ".join(filter(None, name)),
        task_id=digest(" / ".join(name))[:22],
        run_id=digest("run " + " / ".join(name))[:22],
        eval_id=digest("eval " + " / ".join(name))[:22],
        dataset=EvalDataset(name=episodes[0].task.env, samples=len(tasks), sample_ids=tasks),
        model=models[0] if models else episodes[0].policy or "scripted",
        config=EvalConfig(epochs=epochs),
        packages=dict(episodes[0].versions),
        metadata={"agent": dict(episodes[0].spec), "options": dict(episodes[0].task.options)},
    )
    return EvalLog(status="success", eval=spec, samples=samples, results=_results(rows, episodes, samples))


def _results(rows: Sequence[Row], episodes: Sequence[Trajectory], samples: Sequence[Any]) -> Any:
    from inspect_ai.log import EvalMetric, EvalResults, EvalScore

    scores = []
    for name in dict.fromkeys(name for sample in samples for name in sample.scores or {}):
        values = [float(s.scores[name].value) for s in samples if s.scores and name in s.scores]
        mean = EvalMetric(name="mean", value=sum(values) / len(values))
        scores.append(EvalScore(name=name, scorer=name, metrics={"mean": mean}, scored_samples=len(values)))
    completed = sum(t.status == "completed" for t in episodes)
    return EvalResults(total_samples=len(episodes), completed_samples=completed, scores=scores)


def _sample(t: Trajectory, when: datetime, advantages: Advantages, pictures: bool) -> Any:
    from inspect_ai.log import EvalSample
    from inspect_ai.model import ModelOutput
    from inspect_ai.scorer import Score

    first = t.transitions[0].input if t.transitions else None
    shown = pictures_of(t) if pictures else {}
    metric = primary_metric([{"env": t.task.env, **t.metrics}])
    names = dict.fromkeys([metric.name, "return", "success"])
    numbers = {n: t.metrics.get(n) for n in names if isinstance(t.metrics.get(n), bool | int | float)}
    scores = {
        n: Score(value=float(v), explanation=f"ended: {t.metrics.get('ended', '')}")
        for n, v in numbers.items()
        if v is not None
    }
    total = sum(call.latency_s for call in t.calls)
    return EvalSample(
        id=t.task.key,
        epoch=t.rollout + 1,
        input=first.instruction if first else t.task.env,
        target="",
        messages=_messages(t, shown),
        output=ModelOutput.from_content(t.policy or "scripted", t.transitions[-1].action_text if t.transitions else ""),
        scores=scores or None,
        metadata={"seed": t.task.seed, "policy": t.policy, "metrics": plain(t.metrics), "episode": t.episode},
        events=list(events(t, when, advantages.get(t.episode))),
        model_usage=usage_of(t.calls),
        total_time=total,
        working_time=total,
        uuid=digest(t.episode)[:22],
        error=_error(t),
    )


def _error(t: Trajectory) -> Any:
    from inspect_ai.log import EvalError

    return EvalError(message=t.error, traceback="", traceback_ansi="") if t.status == "failed" else None


def _messages(t: Trajectory, shown: Mapping[int, str]) -> list[Any]:
    """The episode as a conversation: what was seen, what was done."""
    from inspect_ai.model import ChatMessageAssistant, ChatMessageSystem, ChatMessageUser, ContentImage, ContentText

    messages: list[Any] = []
    for i, step in enumerate(t.transitions):
        if i == 0:
            messages.append(ChatMessageSystem(id=f"{t.episode}-s", content=step.input.instruction))
        content: Any = step.input.text
        if i in shown:
            content = [ContentText(text=step.input.text), ContentImage(image=shown[i])]
        messages.append(ChatMessageUser(id=f"{t.episode}-u{i}", content=content))
        said = step.decision.rationale
        messages.append(
            ChatMessageAssistant(id=f"{t.episode}-a{i}", content="\n".join(filter(None, (said, step.action_text))))
        )
    return messages


def pictures_of(t: Trajectory) -> dict[int, str]:
    """Step -> what the environment renders before it, as a small data URL; empty where it renders nothing."""
    import io
    from dataclasses import replace

    from PIL import Image

    from agentspec.envs.making import make_env

    try:
        env = make_env(replace(t.task, options={**t.task.options, "render_mode": "rgb_array"}))
    except SpecError:
        return {}
    found: dict[int, str] = {}
    try:
        env.reset(seed=t.task.seed)
        for i, step in enumerate(t.transitions):
            frame = env.render()
            if frame is None:
                return {}
            image = Image.fromarray(frame)
            image.thumbnail((PICTURE, PICTURE))
            buffer = io.BytesIO()
            image.save(buffer, "PNG", optimize=True)
            found[i] = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
            env.step(step.action_text)
    finally:
        env.close()
    return found
