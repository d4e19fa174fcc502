"""Continuous and closed batches: episodes whose answers differ in length.

    python -m benchmarks.batching [--json] [--rollouts 8] [--turns 6] [--shortest 4] [--longest 64] [--repeats 3]

The same episodes (`benchmarks.market`) are played from an empty cache with closed batches and with a continuous one
(see `agentspec.llm.batching`). Every answer has its own number of tokens, drawn evenly from `--shortest ... --longest`
by the seed of its request, with nothing that ends it early: the work is the same however it is batched. Modes take
turns in one process; reported are median seconds, forwards of the model (which do not depend on the machine), and
`ratio`, the closed batch's seconds over the others'.

`same_answers` is the share of answers that are, token by token, those of closed batches, and `same_bits` says that all
repeats agree to the last bit of all log-probabilities. `invariant` says whether the model's arithmetic was found to be
batch-invariant (float32 on a CPU), which promises both. Elsewhere which rows share a forward changes the rounding of
its logits, that moves the border between two of the many improbable tokens, and now and then one is drawn there; from
then on the episode differs, and a continuous batch, where timing decides who shares a forward, does not repeat. The
second part, `slow_env`, is the same with environments that take `--delay` seconds a call and a tiny random model:
there the model should not wait for the environments.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

from agentspec.llm.batching import Batching
from agentspec.llm.local import LocalLLM
from agentspec.llm.local.forward import PackedModel
from benchmarks.rollouts import agent_spec, load_model, market_tasks, tiny


class VariedLengthLLM(LocalLLM):
    """The local backend, except that each answer has a length of its own."""

    def __init__(self, model: Any, tokenizer: Any, batching: Batching, shortest: int, longest: int) -> None:
        super().__init__(model, tokenizer, name="policy", max_cache_tokens=1 << 20, batching=batching)
        self._lengths = shortest, longest
        self._engine._stop_ids = frozenset()
        self.forwards = 0
        forward = self._engine.model.forward

        def counted(segments: Any) -> Any:
            self.forwards += 1
            return forward(segments)

        self._engine.model.forward = counted  # type: ignore[method-assign]

    async def generate(self, request: Any) -> Any:
        """As the backend's, with the length that the request's seed draws."""
        length = random.Random(request.seed).randint(*self._lengths)
        fixed = replace(request.sampling, stop=(), max_tokens=length)
        return await super().generate(replace(request, sampling=fixed))


Play = Callable[[], tuple[float, int, list[Any]]]


def player(llm: VariedLengthLLM, rollouts: int, world: dict[str, Any]) -> Play:
    """A function that plays all episodes from an empty cache: seconds, forwards, and what was written."""
    from agentspec.episode import Job, Runner

    runner = Runner(agent_spec(), llm)
    # The backend checks its own arithmetic once, before the first batch.
    runner.run([Job(market_tasks(1, {**world, "steps": 1, "delay_s": 0.0})[0][0])])
    jobs = [Job(task, rollout) for task, rollout in market_tasks(rollouts, world)]

    def play() -> tuple[float, int, list[Any]]:
        llm.invalidate()
        before = llm.forwards
        start = time.perf_counter()
        episodes = runner.run(jobs)
        seconds = time.perf_counter() - start
        problems = [t.error for t in episodes if t.error or len(t.calls) != world["steps"]]
        if problems:
            raise RuntimeError(f"an episode did not take {world['steps']} turns: {problems[0]}")
        written = [[(c.completions[0].token_ids, c.completions[0].logprobs) for c in t.calls] for t in episodes]
        return seconds, llm.forwards - before, written

    return play


def compare(model: Any, tokenizer: Any, world: dict[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    """All ways of batching in turn."""
    lengths = options.shortest, options.longest
    modes = sorted(get_args(Batching))
    plays = {m: player(VariedLengthLLM(model.eval(), tokenizer, m, *lengths), options.rollouts, world) for m in modes}
    runs: dict[str, list[tuple[float, int, list[Any]]]] = {mode: [] for mode in modes}
    for _ in range(options.repeats):
        for mode, play in plays.items():
            runs[mode].append(play())
        print("  " + ", ".join(f"{mode} {runs[mode][-1][0]:.2f} s" for mode in modes), file=sys.stderr)
    closed = statistics.median(seconds for seconds, _, _ in runs["closed"])
    expected = runs["closed"][0][2]
    return {
        mode: {
            "seconds": (seconds := statistics.median(s for s, _, _ in done)),
            "ratio": closed / seconds,
            "forwards": done[-1][1],
            "tokens": sum(len(ids) for calls in done[-1][2] for ids, _ in calls),
            "same_answers": statistics.mean(_same(written, expected) for _, _, written in done),
            "same_bits": all(written == done[0][2] for _, _, written in done),
        }
        for mode, done in runs.items()
    }


def _same(written: list[Any], expected: list[Any]) -> float:
    """Share of the answers with the tokens expected."""
    pairs = [(a, b) for x, y in zip(written, expected, strict=True) for a, b in zip(x, y, strict=True)]
    return sum(a[0] == b[0] for a, b in pairs) / len(pairs)


def main() -> None:
    """Both parts; a table or JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--model", default="smollm2-135m", help="`tiny`: a random one, for a try")
    parser.add_argument("--rollouts", type=int, default=8, help="episodes, in groups of four")
    parser.add_argument("--turns", type=int, default=6)
    parser.add_argument("--shortest", type=int, default=4, help="tokens of the shortest answer")
    parser.add_argument("--longest", type=int, default=64, help="tokens of the longest answer")
    parser.add_argument("--words", type=int, default=100, help="words of news in an observation")
    parser.add_argument("--delay", type=float, default=0.1, help="seconds of a slow environment's step (0: skip)")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    model, tokenizer = tiny() if options.model == "tiny" else load_model(options.model)
    world: dict[str, Any] = {"steps": options.turns, "words": options.words}
    results: dict[str, Any] = {"invariant": PackedModel(model.eval()).invariant()}
    results["batching"] = compare(model, tokenizer, world, options)
    if options.delay:
        slow = {"steps": options.turns, "words": 2, "delay_s": options.delay}
        results["slow_env"] = compare(*tiny(), slow, options)
    if options.json:
        print(json.dumps(results))
        return
    print(f"batch-invariant: {results.pop('invariant')}")
    for part, modes in results.items():
        for mode, r in modes.items():
            print(
                f"{part:<9} {mode:<10} {r['seconds']:7.2f} s  {r['ratio']:5.2f}x  {r['forwards']:5} forwards  "
                f"{r['tokens']} tokens  same answers {r['same_answers']:.0%}, same bits {r['same_bits']}"
            )


if __name__ == "__main__":
    main()
