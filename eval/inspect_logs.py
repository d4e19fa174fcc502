"""Episodes as Inspect AI logs, for its viewer (`pip install 'agentspec-rl[inspect]'`).

One log per cell (policy, training run and scaffold, on one set of tasks), one sample per task, its epochs are the
repeats. A sample's transcript has a span per step, in it a span per module that called the model, the calls as model
events with their cost and what was credited, what memory recalled and what the environment answered as info events.
Everything goes through Inspect's own API, so its viewer and its analysis tools read it.

A trajectory has no clock times; events stand at the model's latencies after the time at which the file was written.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from agentspec.files import digest, read_lines
from agentspec.metrics import primary_metric
from agentspec.records.folder import UPDATES
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, read_trajectories
from agentspec.types import LLMCall, Transition
from eval.decoding import prompt_text
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
        metadata={"seed": t.task.seed, "policy": t.policy, "metrics": _plain(t.metrics), "episode": t.episode},
        events=list(_events(t, when, advantages.get(t.episode))),
        model_usage=_usage(t.calls),
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


def _events(t: Trajectory, when: datetime, advantage: Any) -> Iterator[Any]:
    """The transcript: a span per step, in it spans of modules with their calls, then what the step led to."""
    from inspect_ai.event import InfoEvent, SpanBeginEvent, SpanEndEvent

    clock = when
    elapsed = 0.0
    steps = {step.step: step for step in t.transitions}
    order = sorted({*steps, *(call.tag.step for call in t.calls)})
    for number in order:
        span = f"{t.episode}-step-{number}"
        label = (
            f"step {number}"
            if number in steps
            else "before the first step"
            if number < 0
            else f"after step {number - 1}"
        )
        yield SpanBeginEvent(id=span, name=label, type="step", span_id=span, timestamp=clock, working_start=elapsed)
        for module, calls in _by_module(t.calls, number):
            inner = f"{span}-{module}"
            yield SpanBeginEvent(
                id=inner,
                name=module,
                type="module",
                parent_id=span,
                span_id=inner,
                timestamp=clock,
                working_start=elapsed,
            )
            for call in calls:
                clock, elapsed = clock + timedelta(seconds=call.latency_s), elapsed + call.latency_s
                yield _model_event(call, inner, clock, elapsed, advantage)
            yield SpanEndEvent(id=inner, span_id=inner, timestamp=clock, working_start=elapsed)
        if number in steps:
            for source, data in _told(steps[number]):
                yield InfoEvent(source=source, data=data, span_id=span, timestamp=clock, working_start=elapsed)
        yield SpanEndEvent(id=span, span_id=span, timestamp=clock, working_start=elapsed)


def _by_module(calls: Iterable[LLMCall], step: int) -> list[tuple[str, list[LLMCall]]]:
    found: dict[str, list[LLMCall]] = {}
    for call in calls:
        if call.tag.step == step:
            found.setdefault(call.tag.module, []).append(call)
    return list(found.items())


def _told(step: Transition) -> Iterator[tuple[str, Any]]:
    trace = {k: v for k, v in step.decision.trace.items() if v}
    if trace:
        yield "reasoning", _plain(trace)
    report = {k: v for k, v in step.info.items() if k not in ("instruction", "action_schema", "state", "metrics") and v}
    yield (
        "environment",
        _plain({"action": step.action_text, "valid": step.decision.valid, "reward": step.reward, **report}),
    )


def _model_event(call: LLMCall, span: str, clock: datetime, elapsed: float, advantage: Any) -> Any:
    from inspect_ai.event import ModelEvent
    from inspect_ai.model import (
        ChatCompletionChoice,
        ChatMessageAssistant,
        ChatMessageUser,
        GenerateConfig,
        ModelOutput,
    )

    text = prompt_text(call) or f"[{len(call.prompt_ids) or call.usage.input_tokens} tokens; no tokenizer at hand]"
    choices = [
        ChatCompletionChoice(
            message=ChatMessageAssistant(id=f"{span}-{call.id}-{i}", content=c.text),
            stop_reason="max_tokens" if c.finish_reason == "length" else "stop",
        )
        for i, c in enumerate(call.completions)
    ]
    trained = any(c.credit == "executed" for c in call.completions)
    metadata = {
        "purpose": call.tag.path,
        "branch": call.tag.branch,
        "credit": [c.credit for c in call.completions],
        "cost": call.usage.cost,
        "advantage": advantage if trained else None,
        "constrained": bool(call.sampling.choices),
    }
    usage = _usage([call])
    return ModelEvent(
        model=call.model or "scripted",
        role=call.tag.purpose,
        input=[ChatMessageUser(id=f"{span}-{call.id}-p", content=text)],
        tools=[],
        tool_choice="none",
        config=GenerateConfig(
            temperature=call.sampling.temperature,
            max_tokens=call.sampling.max_tokens,
            top_p=call.sampling.top_p,
            num_choices=call.sampling.n if call.sampling.n > 1 else None,
            stop_seqs=list(call.sampling.stop) or None,
        ),
        output=ModelOutput(
            model=call.model, choices=choices, usage=next(iter(usage.values()), None), time=call.latency_s
        ),
        metadata={k: v for k, v in metadata.items() if v not in (None, "", False)},
        span_id=span,
        timestamp=clock,
        working_start=elapsed,
        working_time=call.latency_s,
        completed=clock,
    )


def _usage(calls: Iterable[LLMCall]) -> dict[str, Any]:
    from inspect_ai.model import ModelUsage

    found: dict[str, list[float]] = {}
    for call in calls:
        sums = found.setdefault(call.model or "scripted", [0, 0, 0, 0.0])
        for i, value in enumerate(
            (call.usage.input_tokens, call.usage.output_tokens, call.usage.cached_tokens, call.usage.cost)
        ):
            sums[i] += value
    return {
        model: ModelUsage(
            input_tokens=int(tokens_in - cached),
            output_tokens=int(out),
            total_tokens=int(tokens_in + out),
            input_tokens_cache_read=int(cached),
            total_cost=cost or None,
        )
        for model, (tokens_in, out, cached, cost) in found.items()
    }


def _plain(value: Any) -> Any:
    """JSON without what viewers choke on (NaN)."""
    return json.loads(json.dumps(value, default=str).replace("NaN", "null").replace("Infinity", "null"))


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
