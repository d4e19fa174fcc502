"""The transcript of an episode as events of Inspect AI: spans of steps and modules, model calls, what they led to."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from datetime import datetime, timedelta
from typing import Any

from agentspec.trajectory import Trajectory
from agentspec.types import LLMCall, Transition
from eval.decoding import prompt_text


def events(t: Trajectory, when: datetime, advantage: Any) -> Iterator[Any]:
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
        yield "reasoning", plain(trace)
    report = {k: v for k, v in step.info.items() if k not in ("instruction", "action_schema", "state", "metrics") and v}
    yield (
        "environment",
        plain({"action": step.action_text, "valid": step.decision.valid, "reward": step.reward, **report}),
    )


def _model_event(call: LLMCall, span: str, clock: datetime, elapsed: float, advantage: Any) -> Any:
    from inspect_ai.event import ModelEvent
    from inspect_ai.model import ChatMessageUser, GenerateConfig, ModelOutput

    text = prompt_text(call) or f"[{len(call.prompt_ids) or call.usage.input_tokens} tokens; no tokenizer at hand]"
    trained = any(c.credit == "executed" for c in call.completions)
    metadata = {
        "purpose": call.tag.path,
        "branch": call.tag.branch,
        "credit": [c.credit for c in call.completions],
        "cost": call.usage.cost,
        "advantage": advantage if trained else None,
        "constrained": bool(call.sampling.choices),
    }
    usage = usage_of([call])
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
            model=call.model, choices=_choices(call, span), usage=next(iter(usage.values()), None), time=call.latency_s
        ),
        metadata={k: v for k, v in metadata.items() if v not in (None, "", False)},
        span_id=span,
        timestamp=clock,
        working_start=elapsed,
        working_time=call.latency_s,
        completed=clock,
    )


def _choices(call: LLMCall, span: str) -> list[Any]:
    from inspect_ai.model import ChatCompletionChoice, ChatMessageAssistant

    return [
        ChatCompletionChoice(
            message=ChatMessageAssistant(id=f"{span}-{call.id}-{i}", content=c.text),
            stop_reason="max_tokens" if c.finish_reason == "length" else "stop",
        )
        for i, c in enumerate(call.completions)
    ]


def usage_of(calls: Iterable[LLMCall]) -> dict[str, Any]:
    """Model -> what its calls took, in Inspect's form."""
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


def plain(value: Any) -> Any:
    """JSON without what viewers choke on (NaN)."""
    return json.loads(json.dumps(value, default=str).replace("NaN", "null").replace("Infinity", "null"))
