"""What a study will take: episodes, tokens, hours, and the smallest difference it would find.

Tokens are counted, not guessed: the world's scripted expert and its random player play a few tasks through every
scaffold (`agentspec.demonstration`), which writes the very prompts of the study without a model. Episodes of a policy
lie between: the expert's are short, the random player's run into the limit. Tokens of a prompt that an earlier call of
the episode began with, and the static beginning, are not read again. Hours are tokens over rates, of one core.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from agentspec.demonstration import play_expert
from agentspec.llm.base import LLM, Request, user
from agentspec.parameters import check_types
from agentspec.policies import Policy
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import CallTag, Sampling, Task
from eval.matrix import kept_episodes
from eval.statistics import minimum_detectable_effect
from eval.study.plan import START, Study

PLAYERS = ("rule_based", "random")


@dataclass(frozen=True)
class Rates:
    """Tokens per second of one core.

    Args:
        read: of a prompt, while rollouts are sampled.
        write: sampled, while rollouts are sampled.
        update: of all tokens of an update, each once, forward and backward.
        evaluation: how many times faster reading and writing are in evaluation (its dtype).
        source: where the numbers come from.
    """

    read: float
    write: float
    update: float
    evaluation: float = 1.0
    source: str = "given in the study"

    def __post_init__(self) -> None:
        for name in ("read", "write", "update", "evaluation"):
            if not getattr(self, name) > 0:
                raise SpecError(f"rates: {name} must be above 0, got {getattr(self, name)}")

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Rates:
        """From a study's YAML.

        Raises:
            SpecError: an unknown or missing name.
        """
        names = [item.name for item in fields(cls)]
        if unknown := [name for name in data if name not in names]:
            raise SpecError(f"rates: unknown key {unknown[0]!r}; expected {', '.join(names)}")
        if missing := [name for name in names[:3] if name not in data]:
            raise SpecError(f"rates: {', '.join(missing)} missing (tokens per second); or leave `rates` out to measure")
        check_types("rates", cls, data)
        return cls(**data)


async def calibrate(llm: LLM) -> Rates:
    """Rates of a loaded model, from one prompt of about 600 tokens and 32 sampled ones: good for an order of magnitude.

    An update is taken to cost as much as reading its tokens twice.
    """
    text = "The quick brown fox jumps over the lazy dog. " * 60
    seconds = []
    for number, most in enumerate((1, 1, 33)):  # the first call warms up
        messages = (user(f"{number} {text}"),)
        request = Request(messages, Sampling(1.0, max_tokens=most), CallTag("study", "calibrate", str(number), 0))
        began = time.perf_counter()
        call = await llm.generate(request)
        seconds.append(time.perf_counter() - began)
    read = call.usage.input_tokens / seconds[1]
    write = max(1, call.usage.output_tokens - 1) / max(1e-6, seconds[2] - seconds[1])
    return Rates(read, write, read / 2, 1.0, "measured just now, from two prompts")


@dataclass(frozen=True)
class Work:
    """Tokens of an episode, on average: read anew, and sampled; and its steps."""

    read: float
    write: float
    steps: float

    def seconds(self, rates: Rates, times: float = 1.0) -> float:
        """Of one core, `times` as fast as the rates say."""
        return (self.read / rates.read + self.write / rates.write) / times

    def update_seconds(self, rates: Rates) -> float:
        """Of an update over the episode."""
        return (self.read + self.write) / rates.update


def work_of(spec: AgentSpec, tokenizer: Any, tasks: Sequence[Task], player: str) -> Work:
    """What an episode of a scaffold takes when `player` plays it."""
    episodes = play_expert(spec, tokenizer, tasks, expert=player)
    static: dict[str, tuple[int, ...]] = {}  # the first prompt of each kind, whose beginning all episodes share
    read = write = 0
    for episode in episodes:
        here = list(static.values())
        for call in episode.calls:
            static.setdefault(call.tag.path, call.prompt_ids)
            read += len(call.prompt_ids) - max((_common(call.prompt_ids, earlier) for earlier in here), default=0)
            for completion in call.completions:
                free = [a is None or len(a) > 1 for a in completion.allowed or (None,) * len(completion.token_ids)]
                write += sum(free)
                read += len(free) - sum(free)
                here.append((*call.prompt_ids, *completion.token_ids))
    return Work(read / len(episodes), write / len(episodes), _steps(episodes))


def _steps(episodes: Sequence[Trajectory]) -> float:
    return sum(len(e.transitions) for e in episodes) / len(episodes)


def _common(a: Sequence[int], b: Sequence[int]) -> int:
    return next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))


@dataclass(frozen=True)
class Rounds:
    """Training of one run of an arm: generation rounds, and episodes of each."""

    rounds: int
    episodes: int


def estimate(
    study: Study,
    model: str,
    tasks: Mapping[str, Sequence[Task]],
    rounds: Mapping[str, Rounds],
    *,
    start: str = "",
    lora: bool = True,
    warmup: tuple[int, float] = (0, 0.0),
) -> str:
    """What a study plays and takes, as text; nothing is written.

    Args:
        model, start, lora: as of `Study.policies`; a start that is not there yet was evaluated nowhere.
        tasks: held-out ones; the first three are played by script.
        rounds: by arm.
        warmup: demonstrations, and how often each is trained on.
    """
    from transformers import AutoTokenizer

    from agentspec.llm.models import resolve

    tokenizer, few = AutoTokenizer.from_pretrained(resolve(model).path), next(iter(tasks.values()))[:3]
    works = {s: [work_of(spec, tokenizer, few, p) for p in PLAYERS] for s, spec in study.scaffolds.items()}
    policy: Any = Policy(START, model, backend=dict(study.evaluation.get("backend", {})))
    rates = Rates.from_data(study.rates) if study.rates else asyncio.run(calibrate(policy.build()))
    kept = 0
    if not start or Path(start).is_dir():
        policies = study.policies(model, start, lora=lora)
        kept = kept_episodes(policies, study.scaffolds, tasks, study.settings, study.out)
    return plan(study, rounds, works, rates, warmup=warmup, kept=kept)


def plan(
    study: Study,
    rounds: Mapping[str, Rounds],
    works: Mapping[str, Sequence[Work]],
    rates: Rates,
    *,
    warmup: tuple[int, float] = (0, 0.0),
    kept: int = 0,
) -> str:
    """The estimate from its parts.

    Args:
        works: by scaffold, as of `PLAYERS`.
        kept: episodes of the evaluation that are there already.
    """
    lines, trained = _trainings(study, rounds, works, rates)
    policies = 1 + len(study.runs)
    each = study.tasks * study.settings.rollouts
    played = [policies * each * sum(w[i].seconds(rates, rates.evaluation) for w in works.values()) for i in (0, 1)]
    evaluated = [seconds / 3600 for seconds in played]
    mean = [sum(w[i].update_seconds(rates) for w in works.values()) / len(works) for i in (0, 1)]
    warm = warmup[0] * warmup[1] * mean[0] / 3600  # demonstrations are the expert's
    total = [a + b + warm for a, b in zip(trained, evaluated, strict=True)]
    steps = "; ".join(f"{label} {a.steps:.0f}-{b.steps:.0f}" for label, (a, b) in works.items())
    return "\n".join(
        [
            f"{len(study.runs)} training runs:",
            *lines,
            f"evaluation: {policies} policies x {len(study.scaffolds)} scaffolds x {each} episodes = "
            f"{policies * len(study.scaffolds) * each} episodes, and {len(study.references)} scripted policies; "
            f"{kept} are in the store",
            f"warm start: {warmup[0]} demonstrations, each {warmup[1]:g} times" if warmup[0] else "warm start: none",
            f"steps of an episode (expert - random player): {steps}",
            f"estimated hours of one core: training {_span(trained)}, evaluation {_span(evaluated)}, warm start "
            f"{warm:.2f}; in all {_span(total)}",
            f"  rates ({rates.source}): read {rates.read:.0f}, write {rates.write:.0f}, update {rates.update:.0f} "
            f"tokens/s; evaluation {rates.evaluation:g} times as fast. The lower end is the expert's episodes, the "
            "upper the random player's; episodes played side by side are faster.",
            *_detectable(study),
        ]
    )


def _trainings(
    study: Study, rounds: Mapping[str, Rounds], works: Mapping[str, Sequence[Work]], rates: Rates
) -> tuple[list[str], list[float]]:
    """A line per arm, and the hours of all (fewest, most)."""
    lines, seeds = list[str](), len(study.seeds)
    trained = [0.0, 0.0]
    for name, arm in study.arms.items():
        r = rounds[name]
        hours = [
            seeds * r.rounds * r.episodes * (w.seconds(rates) + w.update_seconds(rates)) / 3600
            for w in works[arm.scaffold]
        ]
        trained = [a + b for a, b in zip(trained, hours, strict=True)]
        lines.append(
            f"  {name:<24} in {arm.scaffold:<24} {seeds} runs x {r.rounds} updates x {r.episodes} rollouts = "
            f"{seeds * r.rounds * r.episodes:>5} episodes  {_span(hours)} h"
        )
    return lines, trained


def _detectable(study: Study) -> Iterable[str]:
    seeds, arms = len(study.seeds), len(study.arms)
    if not study.deviation:
        yield "smallest difference found: set `deviation`, what a run's contrast varies by from run to run"
        return
    if seeds < 2:
        yield "smallest difference found: one run an arm says nothing about training; give two seeds and more"
        return
    one = minimum_detectable_effect(study.deviation, seeds)
    freedom = arms * (seeds - 1) + 1
    whole = minimum_detectable_effect(study.deviation * (freedom / (arms * seeds)) ** 0.5, freedom)
    yield (
        f"found in four of five studies, if a run's contrast deviates by {study.deviation:g} (assumed): an arm against "
        f"the start ({seeds} runs) from {one:.3g} on, the diagonal ({arms * seeds} runs) from {whole:.3g} on; before "
        "Holm's correction"
    )


def _span(hours: Sequence[float]) -> str:
    return f"{hours[0]:.2f}-{hours[1]:.2f}"


def cpu_seconds() -> float:
    """CPU seconds of this process so far, all threads."""
    times = os.times()
    return times.user + times.system
