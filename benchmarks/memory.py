"""What a memory costs beside the model: storing, retrieving, snapshots, at 100 to 100,000 steps.

    python -m benchmarks.memory [--json] [--methods amem mem0] [--sizes 100 1000 10000 100000] [--preset paper]

Every registered memory is filled with the steps of a courier's days (an episode ends every 40 steps), its questions
answered by a script: the examples that it declares, with sentences of such a day in place of theirs, so that what is
kept differs from entry to entry. Time is the processor's, and what is spent in the model and in the embedder is not
counted: what is left is the method itself, whatever else the machine does. Per method and size, in milliseconds:

- `retrieve_p50_ms`, `retrieve_p99_ms`, `store_p50_ms`, `store_p99_ms`: one call, of 50.
- `episode_p50_ms`: what an episode's end and the beginning of the next take.
- `snapshot_ms`: median of 5, each after one more step. `first_snapshot_ms`: the first one of an instance that has just
  been restored (what an episode that starts from a carried memory pays at its end; nothing is written yet).
- `restore_ms`: restored into a fresh instance, and used once (indexes may be built then).
- `bytes_per_entry`: snapshot per stored step; `growth`: how the snapshot grew since the size before, as a share of how
  the number of steps did (1: in proportion, 0: not at all, as of a memory with a cap or a sheet of fixed length).
- `entries`: what the method says that it holds, where it does; `filled`: steps stored; `not_reached`: why these are
  fewer than the size (a cell is filled for at most `--seconds`, and the larger sizes of the method are left out).

A method that raises has its error in place of figures, and the exit code is 1.

Beside them, where they are installed, libraries with the same sentences and vectors: `chromadb` (an ephemeral
collection), `langmem_store` (the store of LangGraph that LangMem writes into) and `mem0ai` (its local Qdrant, without
the model); and `vector_index`, what this package's memories store in, without the bounds that a method sets.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import statistics
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agentspec.agent import Agent
from agentspec.embedding import CachedEmbedder, HashEmbedder
from agentspec.llm.base import Message, Request
from agentspec.llm.recorder import Recorder
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.tokens import estimate_tokens
from agentspec.trajectory import Trajectory
from agentspec.types import (
    Action,
    ActionSchema,
    ActionSpec,
    AgentInput,
    Completion,
    Decision,
    LLMCall,
    Task,
    Transition,
    Usage,
)
from benchmarks.memory_libraries import LIBRARIES
from benchmarks.retrieval import sentence

EPISODE = 40
clock = time.process_time
"""Processor time: what others do on the machine is none of the method's."""
REPEATS = 50
SNAPSHOTS = 5
SIZES = (100, 1000, 10_000, 100_000)
NOT_MEMORIES = ("none",)
SCHEMA = ActionSchema({"WAIT": ActionSpec("WAIT", "wait", example="WAIT(60)")})
TASK = Task("deliverybench")


@dataclass
class Stopwatch:
    """Seconds spent in the model and in the embedder, to be taken off."""

    spent: float = 0.0

    def ms(self, began: float, spent: float) -> float:
        """Milliseconds since `began`, less what was spent in models since it stood at `spent`."""
        return 1e3 * (clock() - began - (self.spent - spent))


@dataclass
class TimedEmbedder:
    """An embedder whose time is taken off."""

    inner: CachedEmbedder
    watch: Stopwatch

    @property
    def dim(self) -> int:
        """Of the vectors."""
        return self.inner.dim

    def embed(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Vectors of the texts."""
        began = clock()
        vectors = self.inner.embed(texts)
        self.watch.spent += clock() - began
        return vectors


@dataclass
class Script:
    """Answers what a memory asks by its declared examples; no token is made of it, and its time is taken off."""

    watch: Stopwatch
    rng: random.Random = field(default_factory=lambda: random.Random(0))
    name: str = "script"
    capabilities: frozenset[str] = frozenset({"n", "score", "choices"})
    max_context: int = 1_000_000

    async def generate(self, request: Request) -> LLMCall:
        """The example of the purpose, with new sentences."""
        began = clock()
        text = request.sampling.choices[0] if request.sampling.choices else self._example(request)
        used = Usage(sum(estimate_tokens(m.text) for m in request.messages), estimate_tokens(text))
        call = LLMCall(request.id, request.tag, (), (Completion(text),) * request.sampling.n, request.sampling, used)
        self.watch.spent += clock() - began
        return call

    async def score(
        self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = ""
    ) -> tuple[float, ...]:
        """Shorter is likelier."""
        return tuple(-float(len(c)) for c in continuations)

    def count_tokens(self, text: str) -> int:
        """As every counter that has no tokenizer."""
        return estimate_tokens(text)

    def enter(self, episode: str) -> None:
        """Nothing to do."""

    def leave(self, episode: str) -> None:
        """Nothing to do."""

    def _example(self, request: Request) -> str:
        kind, _, name = request.tag.module.partition(".")
        purpose = REGISTRY.get(kind, name).purposes.get(request.tag.purpose)
        example = purpose.example if purpose else ""
        try:
            return json.dumps(self._fresh(json.loads(example)))
        except ValueError:
            return example if "<" in example else sentence(self.rng)

    def _fresh(self, value: Any) -> Any:
        """Texts of several words are sentences: each becomes a new one."""
        if isinstance(value, dict):
            return {key: self._fresh(v) for key, v in value.items()}
        if isinstance(value, list):
            return [self._fresh(v) for v in value]
        return sentence(self.rng) if isinstance(value, str) and " " in value.strip() else value


class Filled:
    """One memory with a script for a model, and the steps that it was told of."""

    def __init__(self, name: str, params: Mapping[str, Any], *, dim: int, cached: int) -> None:
        self.name, self.params = name, params
        self.watch = Stopwatch()
        self.embedder = TimedEmbedder(CachedEmbedder(HashEmbedder(dim), cached), self.watch)
        self.rng = random.Random(0)
        self.agent = self.build()
        self.agent.begin_episode(TASK)
        self.steps = 0
        self._episode: list[Transition] = []

    def build(self) -> Agent:
        """A fresh agent around the memory."""
        scope = REGISTRY.get("memory", self.name).declaration.scope or "run"
        memory = {"name": self.name, **self.params}
        spec = AgentSpec.from_data({"memory": memory, "layout": "snapshot", "scope": scope, "embedder": "hash"})
        return spec.build(Recorder(Script(self.watch), episode="", seed=0), embedder=self.embedder)

    def input(self) -> AgentInput:
        """Something new to see."""
        text = sentence(self.rng)
        return AgentInput("Deliver orders and earn money.", text, SCHEMA, {"text": text})

    def transition(self) -> Transition:
        """The next step."""
        decision = Decision(Action("WAIT", (60,), text="WAIT(60)"), "wait for the food")
        ended = len(self._episode) == EPISODE - 1
        report = {"message": sentence(self.rng), "error": "", "invalid": False, "success": ended}
        reward = float(self.rng.randrange(3))
        seen = self.input()
        step = len(self._episode)
        return Transition(step, seen, decision, "WAIT(60)", reward, sentence(self.rng), ended, False, report)

    async def store(self) -> float:
        """Store one step; milliseconds."""
        transition = self.transition()
        self._episode.append(transition)
        self.agent.clock.step = self.agent.recorder.step = transition.step + 1
        ms = await self._timed(lambda: self.agent.memory.store(transition))
        self.steps += 1
        return ms

    async def turn(self) -> float:
        """End the episode and begin the next; milliseconds."""
        trajectory = Trajectory(TASK, {}, transitions=tuple(self._episode))
        self._episode = []

        async def work() -> None:
            await self.agent.memory.end_episode(trajectory)
            self.agent.clock.resume(self.agent.clock.carry())
            self.agent.begin_episode(TASK)

        return await self._timed(work)

    async def fill(self, size: int, seconds: float) -> None:
        """Store steps until there are `size`, or the time is over."""
        end = clock() + seconds
        while self.steps < size and clock() < end:
            await self.store()
            if len(self._episode) == EPISODE:
                await self.turn()

    async def retrieve(self) -> float:
        """Retrieve for something new; milliseconds."""
        seen = self.input()
        self.embedder.inner.embed([seen.text])
        return await self._timed(lambda: self.agent.memory.retrieve(seen))

    async def restore(self, blob: bytes) -> tuple[float, float]:
        """Milliseconds: restore into a fresh instance and retrieve once; its first snapshot."""
        other, seen = self.build(), self.input()
        other.begin_episode(TASK)

        async def work() -> None:
            other.memory.restore(blob)
            await other.memory.retrieve(seen)

        restored = await self._timed(work)
        began = clock()
        other.memory.snapshot()
        return restored, 1e3 * (clock() - began)

    async def _timed(self, work: Callable[[], Awaitable[Any]]) -> float:
        began, spent = clock(), self.watch.spent
        await work()
        ms = self.watch.ms(began, spent)
        self.agent.recorder.calls.clear()  # a run of one episode would not ask as often
        return ms


async def measured(filled: Filled, size: int, seconds: float) -> dict[str, Any]:
    """The figures at one size."""
    await filled.fill(size, seconds)
    steps = filled.steps
    retrieved = [await filled.retrieve() for _ in range(REPEATS)]
    stored, ended = [], []
    for _ in range(REPEATS):
        stored.append(await filled.store())
        if len(filled._episode) == EPISODE:
            ended.append(await filled.turn())
    snapshots, blob = [], b""
    for _ in range(SNAPSHOTS):
        await filled.store()
        if len(filled._episode) == EPISODE:
            await filled.turn()
        began = clock()
        blob = filled.agent.memory.snapshot()
        snapshots.append(1e3 * (clock() - began))
    restored, first = zip(*[await filled.restore(blob) for _ in range(SNAPSHOTS)], strict=True)
    figures = {
        **quantiles("retrieve", retrieved),
        **quantiles("store", stored),
        "episode_p50_ms": statistics.median(ended) if ended else 0.0,
        "snapshot_ms": statistics.median(snapshots),
        "restore_ms": statistics.median(restored),
        "first_snapshot_ms": statistics.median(first),
        "bytes": len(blob),
        "bytes_per_entry": len(blob) / filled.steps,
        "filled": steps,
        "stored": filled.steps,
    }
    if steps < size:
        figures["not_reached"] = f"{seconds:g} s of storing gave {steps} steps"
    own = getattr(filled.agent.memory, "metrics", dict)()
    return figures | ({"entries": own["entries"]} if "entries" in own else {})


def quantiles(name: str, times: Sequence[float]) -> dict[str, float]:
    """Median and 99th percentile."""
    ordered = sorted(times)
    last = min(len(ordered) - 1, int(0.99 * len(ordered)))
    return {f"{name}_p50_ms": statistics.median(ordered), f"{name}_p99_ms": ordered[last]}


def with_growth(rows: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Each size with how the snapshot grew since the size before, for how the number of steps did."""
    before: dict[str, Any] | None = None
    for row in rows.values():
        if before and row["stored"] > before["stored"]:
            steps, size = row["stored"] / before["stored"], row["bytes"] / max(1, before["bytes"])
            row["growth"] = round((size - 1) / (steps - 1), 3)
        before = row
    return rows


def methods(names: Sequence[str] = ()) -> dict[str, Mapping[str, Mapping[str, Any]]]:
    """Method -> its presets; all that are registered."""
    found: dict[str, Mapping[str, Mapping[str, Any]]] = {}
    for name, entry in REGISTRY.all("memory").items():
        if (not names and name not in NOT_MEMORIES and not entry.declaration.extra) or name in names:
            found[name] = {preset: {"preset": preset} for preset in entry.presets} or {"": {}}
    for name in set(names) - set(found) - set(LIBRARIES):
        entry = REGISTRY.get("memory", name)  # an alias, or an error with the nearest names
        found[entry.name] = {preset: {"preset": preset} for preset in entry.presets} or {"": {}}
    return found


def measure(
    names: Sequence[str], sizes: Sequence[int], preset: str, seconds: float, dim: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Method by method its figures by size."""
    for name, presets in methods(names).items():
        filled = Filled(name, presets.get(preset, presets.get("", {})), dim=dim, cached=20 * max(sizes) + 10_000)
        rows: dict[str, dict[str, Any]] = {}
        try:
            for size in sorted(sizes):
                rows[str(size)] = asyncio.run(measured(filled, size, seconds))
                if "not_reached" in rows[str(size)]:
                    break
            with_growth(rows)
        except Exception as error:
            rows["error"] = {"error": f"{type(error).__name__}: {error}"}
        yield name, rows
    for name, library in LIBRARIES.items():
        if not names or name in names:
            given = {str(size): library(size, REPEATS, dim) for size in sorted(sizes)}
            yield name, {size: row for size, row in given.items() if row is not None}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    description, _, rest = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        allow_abbrev=False,
        description=description,
        epilog=rest,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--methods", nargs="*", default=[], metavar="NAME", help="these only (default: all)")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), help="steps stored (default: %(default)s)")
    parser.add_argument("--preset", default="paper", help="of methods that have presets (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=120.0, help="to fill one size, at most (default: %(default)s)")
    parser.add_argument("--dim", type=int, default=384, help="of the vectors (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args(argv)
    results: dict[str, Any] = {}
    for name, rows in measure(arguments.methods, arguments.sizes, arguments.preset, arguments.seconds, arguments.dim):
        results[name] = rows
        if not arguments.json:
            print_rows(name, rows)
    if arguments.json:
        print(json.dumps(results))
    return int(any("error" in rows for rows in results.values()))


def print_rows(name: str, rows: Mapping[str, Mapping[str, Any]]) -> None:
    """One line per size."""
    if not rows:
        print(f"{name}: not installed here, not compared", flush=True)
    for size, row in rows.items():
        cells = [f"{key} {row[key]:.3f}" if isinstance(row[key], float) else f"{key} {row[key]}" for key in row]
        print(f"{name:<20} {size:>7}  {', '.join(cells)}", flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
