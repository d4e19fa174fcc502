"""Measure what the methods cost: ``python docs/measure_modules.py [--steps 20] [--model smollm2-135m] [METHOD ...]``.

Every reasoning and reflection method plays the same DeliveryBench shift in menu mode, under preset ``rl`` where it has
one, with a real model; calls, tokens and seconds per step go into the second table of docs/modules.md. A method is
``reasoning`` or ``reasoning+reflection``.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from update_modules import PAGE

from agentspec.episode import Job, Runner
from agentspec.files import write_atomic
from agentspec.llm.local import LocalLLM
from agentspec.registry import REGISTRY
from agentspec.spec import AgentSpec
from agentspec.types import Task

BEGIN, END = "<!-- generated: measured costs -->", "<!-- end of costs -->"
WORLD = {"size": "tiny", "shift_hours": 1.0, "observation": "compact", "action_mode": "menu"}
MAX_TOKENS = 32


def methods() -> list[str]:
    """Every reasoner that calls a model, and every reflection under ``direct``."""
    reasoners = [name for name, entry in REGISTRY.entries["reasoning"].items() if not entry.scripted]
    return [*reasoners, *(f"direct+{name}" for name in REGISTRY.entries["reflection"] if name != "none")]


def module(kind: str, name: str) -> Any:
    """The module as a spec has it, under preset ``rl`` where there is one."""
    return {"name": name, "preset": "rl"} if REGISTRY.get(kind, name).presets else name


def measure(method: str, llm: LocalLLM, steps: int) -> str:
    """One row of the table."""
    reasoning, _, reflection = method.partition("+")
    spec = AgentSpec.from_data(
        {
            "reasoning": module("reasoning", reasoning),
            "reflection": module("reflection", reflection or "none"),
            "scope": REGISTRY.get("reflection", reflection or "none").declaration.scope or "episode",
            "layout": "snapshot",
            "sampling": {"max_tokens": MAX_TOKENS},
        }
    )
    started = time.perf_counter()
    (played,) = Runner(spec, llm, max_steps=steps, timeout_s=None).run([Job(Task("deliverybench", 0, WORLD))])
    seconds = time.perf_counter() - started
    if played.status != "completed":
        raise RuntimeError(f"{method}: {played.error}")
    m, n = played.metrics, max(1, played.metrics["steps"])
    cells = [
        f"`{method}`",
        str(m["steps"]),
        f"{m['llm_calls'] / n:.1f}",
        f"{m['input_tokens'] / n:.0f}",
        f"{m['cached_tokens'] / max(1, m['input_tokens']):.0%}",
        f"{m['output_tokens'] / n:.0f}",
        f"{seconds / n:.2f}",
        str(m["fallbacks"]),
    ]
    return "| " + " | ".join(cells) + " |"


HEAD = [
    "| method | steps | calls per step | tokens in | of them cached | tokens out | seconds per step | fallbacks |",
    "|---|---|---|---|---|---|---|---|",
]


def with_rows(page: str, rows: dict[str, str]) -> str:
    """The page with ``rows`` (by method) in its table, in the order of :func:`methods`; other rows stay."""
    before, _, rest = page.partition(BEGIN)
    table, _, after = rest.partition(END)
    known = {line.split("`")[1]: line for line in table.splitlines() if line.startswith("| `")} | rows
    lines = [*HEAD, *(known[method] for method in methods() if method in known)]
    return f"{before}{BEGIN}\n" + "\n".join(lines) + f"\n{END}{after}"


def main() -> None:
    """Measure the methods named (all by default); each row is written as soon as it is known."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__)
    parser.add_argument("method", nargs="*")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--model", default="smollm2-135m")
    arguments = parser.parse_args()
    llm = LocalLLM.load(arguments.model, dtype="float32", device="cpu")
    for method in arguments.method or methods():
        row = measure(method, llm, arguments.steps)
        print(row, flush=True)
        write_atomic(PAGE, with_rows(PAGE.read_text(encoding="utf-8"), {method: row}))


if __name__ == "__main__":
    main()
