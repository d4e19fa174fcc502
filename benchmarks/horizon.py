"""Long horizons: the context of GRPO (full history) and of SUPO (summaries) as episodes get longer.

    python -m benchmarks.horizon [--json] [--turns 8 16 32 64 128] [--model smollm2-135m] [--rollouts 4] [--bytes]

The same scripted market for both: ``grpo`` keeps the whole conversation, ``supo`` replaces it by a summary every eight
actions. Answers come from a script, so that both agents act alike and episodes last exactly as long as they should;
with ``--model`` they come from a model, and time and memory are those of real sampling. ``peak_context`` is the longest
prompt plus answer of an episode in tokens (of the bundled model for the script, or ``--bytes``: scripted prompts have a
byte for a token), ``seconds`` the time of one episode: wall-clock with a model, of the processor for the script,
``rss_mb`` by how much the process grew, at most, beyond its size before the episode. The curves go to
``docs/images/horizon.png``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

IMAGE = Path(__file__).resolve().parents[1] / "docs" / "images" / "horizon.png"
EVERY = 8
SUMMARY = "Sold whenever the price was high, waited otherwise. Prices change at every step; go on like this."

AGENTS: dict[str, dict[str, Any]] = {
    "grpo": {"reasoning": "direct", "memory": "none", "sampling": {"max_tokens": 16}},
    "supo": {
        "reasoning": "direct",
        "memory": {"name": "summary", "every": EVERY, "summary_tokens": 128},
        "sampling": {"max_tokens": 16},
    },
}


def script(request: Any) -> str:
    """Sell at five and more, else wait; the same summary every time."""
    if request.tag.purpose == "summary":
        return SUMMARY
    price = int(request.messages[-1].text.rpartition("The price is ")[2].partition(".")[0])
    return "SELL()" if price >= 5 else "WAIT()"


def make_llm(model: str) -> Any:
    """The script, or a model in float32 on the CPU (an accelerator if there is one)."""
    if not model:
        from agentspec.llm.scripted import ScriptedLLM

        return ScriptedLLM(script)
    from agentspec.llm.local import LocalLLM

    return LocalLLM.load(model, dtype="float32")


def counter(llm: Any, options: argparse.Namespace) -> Callable[[Sequence[int]], int]:
    """Token ids of a call -> how many tokens they are; bytes of a script are encoded by the bundled model."""
    if options.model or options.bytes:
        return len
    from transformers import AutoTokenizer

    from agentspec.llm.models import resolve

    tokenizer = AutoTokenizer.from_pretrained(resolve("smollm2-135m").path)
    return lambda ids: len(tokenizer.encode(llm.tokenizer.decode(ids)))


def measure(
    llm: Any, agent: str, turns: int, options: argparse.Namespace, count: Callable[[Sequence[int]], int] = len
) -> dict[str, Any]:
    """Episodes of ``turns`` actions, one after the other: medians over them."""
    from agentspec.episode import Job, Runner
    from agentspec.llm.local.release import release
    from agentspec.spec import AgentSpec
    from agentspec.types import Task
    from benchmarks.market import MARKET
    from benchmarks.measuring import PeakMemory

    world = {"steps": turns, "words": options.words, "menu": bool(options.model)}
    runner = Runner(AgentSpec.from_data(AGENTS[agent]), llm)
    peaks, seconds, grown, ends = [], [], [], set()
    for seed in range(options.rollouts):
        if options.model:
            llm.invalidate()
        release()
        with PeakMemory() as growth:
            clock = time.perf_counter if options.model else time.process_time
            start = clock()
            (episode,) = runner.run([Job(Task(MARKET, seed, world))])
            seconds.append(clock() - start)
        peaks.append(max(count([*c.prompt_ids, *c.completions[0].token_ids]) for c in episode.calls))
        grown.append(growth.peak_mb)
        ends.add(str(episode.metrics["ended"]))
    return {
        "turns": turns,
        "peak_context": max(peaks),
        "seconds": statistics.median(seconds),
        "rss_mb": statistics.median(grown),
        "ended": sorted(ends),
    }


def draw(results: dict[str, list[dict[str, Any]]], unit: str, clock: str, path: Path) -> None:
    """Peak context, time and memory over the number of turns."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import MultipleLocator

    panels = (
        ("peak_context", f"peak context ({unit})"),
        ("seconds", f"time of an episode ({clock})"),
        ("rss_mb", "growth of memory (MiB)"),
    )
    figure, axes = pyplot.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
    for axis, (key, label) in zip(axes, panels, strict=True):
        for name, title in (("grpo", "GRPO, full history"), ("supo", f"SUPO, summary every {EVERY}")):
            points = results[name]
            axis.plot([p["turns"] for p in points], [p[key] for p in points], marker="o", label=title)
        axis.set_xlabel("turns (actions of an episode)")
        axis.xaxis.set_major_locator(MultipleLocator(16))
        axis.set_title(label, fontsize=10)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axes[0].legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def main() -> None:
    """All lengths for both agents; a table or JSON, and the plot."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--turns", type=int, nargs="+", default=[8, 16, 32, 64, 128])
    parser.add_argument("--model", default="", help="a model to sample from (default: a script)")
    parser.add_argument("--bytes", action="store_true", help="count bytes of scripted prompts (needs no tokenizer)")
    parser.add_argument("--words", type=int, default=40, help="words of news in an observation")
    parser.add_argument("--rollouts", type=int, default=4, help="episodes per length, one at a time")
    parser.add_argument("--plot", type=Path, default=IMAGE, metavar="FILE")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    llm = make_llm(options.model)
    for agent in AGENTS:  # imports, caches
        measure(llm, agent, 2, options)
    count = counter(llm, options)
    results = {agent: [measure(llm, agent, turns, options, count) for turns in options.turns] for agent in AGENTS}
    draw(results, "bytes" if options.bytes else "tokens", "s" if options.model else "s of CPU", options.plot)
    if options.json:
        print(json.dumps(results))
        return
    for agent, points in results.items():
        for p in points:
            print(
                f"{agent}  {p['turns']:>4} turns  peak context {p['peak_context']:>7}  {p['seconds']:8.3f} s  "
                f"{p['rss_mb']:7.1f} MiB  ended: {', '.join(p['ended'])}"
            )


if __name__ == "__main__":
    main()
