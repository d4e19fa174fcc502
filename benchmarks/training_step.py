"""One update on the same rows: prefix-tree packing beside stock TRL's padded rows.

    python -m benchmarks.training_step [--json] [--rollouts 4] [--turns 8] [--repeats 1] [--adapter NAME] [--reference]

Rows have the shape of real episodes in three layouts (token counts of the quick-start: a static prompt, then an
observation and an action per turn): ``conversation`` is one row per episode, ``snapshot`` one per step, ``supo`` one
per summary segment. Both sides see the same tokens, masks and advantages and the same LoRA policy; they run in turn,
A B A B, in one process, and the median is reported. Stock TRL gets its own batches: prompts padded left, completions
padded right, the rows of a micro-batch as they come. ``rel_grad_diff`` and ``max_rel_grad_diff`` compare the gradients:
what they mean, and what ``--reference`` adds, is told in `benchmarks.gradient_error`.

The policy is the quick-start's: LoRA on the upper 12 of 30 layers. ``ours`` starts above the frozen ones, from what the
local backend left of them while it sampled, as training does; ``alone`` has to compute that itself. ``cpu_ratio``
compares seconds of processor time, which a busy machine blurs less. ``utilisation`` is the time that the update's
matrix products and its logits would take at the ceilings measured in the same run (a large product; a copy), over the
processor time it took; attention is not counted.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from agentspec.llm.local.release import release
from benchmarks.gradient_error import Gradients, differences, errors, gradients, in_float64
from benchmarks.measuring import PeakMemory, ceilings, clock

LAYOUTS = {"conversation": 8, "snapshot": 6, "supo": 16}
"""Layout -> turns of an episode: SUPO's are long enough for two segments."""
STATIC, OBSERVATION, ANSWER, SUMMARY, SEGMENT = 300, 120, 8, 60, 8


def make_rows(layout: str, rollouts: int, turns: int, vocabulary: int, seed: int = 0) -> list[Any]:
    """Rows of ``rollouts`` episodes in groups of four that start alike; the answers are trained."""
    from trainers.sequences import Row, TokenSequence

    rng = random.Random(seed)

    def draw(n: int) -> list[int]:
        return [rng.randrange(100, vocabulary) for _ in range(n)]

    static, rows = draw(STATIC), []
    first: list[int] = []
    for episode in range(rollouts):
        if episode % 4 == 0:
            first = draw(OBSERVATION)
        advantage = rng.choice((-1.3, -0.4, 0.6, 1.1))
        carried: list[int] = []
        sequence: TokenSequence | None = None
        for turn in range(turns):
            observation = first if turn == 0 else draw(OBSERVATION + rng.randrange(-20, 20))
            if layout == "supo" and turn and turn % SEGMENT == 0 and sequence is not None:
                summary = draw(SUMMARY)
                sequence.extend_context(draw(20))
                _trained(sequence, summary)
                carried, sequence = summary, None
            if sequence is None or layout == "snapshot":
                sequence = TokenSequence()
                sequence.extend_context([*static, *carried])
                rows.append(Row(sequence, advantage, episode))
            sequence.extend_context(observation)
            _trained(sequence, draw(ANSWER))
    return rows


def _trained(sequence: Any, tokens: Sequence[int]) -> None:
    start = len(sequence)
    sequence.extend_context(list(tokens))
    sequence.paths[0] = "reasoning.direct/act"
    for p in range(start, len(sequence)):
        sequence.mask[p], sequence.calls[p] = 1, 0


def stock_update(trainer: Any, rows: Sequence[Any], micro: int) -> Callable[[], None]:
    """Forward and backward of ``rows`` as stock ``GRPOTrainer`` does it, ``micro`` rows at a time."""
    from trl.trainer.utils import pad

    total = torch.tensor(sum(r.sequence.trained for r in rows))
    heads = [r.sequence.mask.index(1) for r in rows]

    def tensor(values: list[list[int]], side: str, value: int) -> torch.Tensor:
        padded: torch.Tensor = pad([torch.tensor(v) for v in values], padding_value=value, padding_side=side)
        return padded

    batch = {
        "prompt_ids": tensor([r.sequence.tokens[:h] for r, h in zip(rows, heads, strict=True)], "left", 0),
        "prompt_mask": tensor([[1] * h for h in heads], "left", 0),
        "completion_ids": tensor([r.sequence.tokens[h:] for r, h in zip(rows, heads, strict=True)], "right", 0),
        "completion_mask": tensor([[1] * (len(r.sequence) - h) for r, h in zip(rows, heads, strict=True)], "right", 0),
        "tool_mask": tensor([r.sequence.mask[h:] for r, h in zip(rows, heads, strict=True)], "right", 0),
        "advantages": torch.tensor([r.advantage for r in rows]),
    }
    count = -(-len(rows) // micro)
    _accumulate(trainer, count)

    def run() -> None:
        for start in range(0, len(rows), micro):
            part = {k: v[start : start + micro] for k, v in batch.items()}
            trainer._compute_loss(trainer.model, part | {"num_items_in_batch": total}).backward()

    return run


def our_update(trainer: Any, rows: Sequence[Any], count: int) -> Callable[[], None]:
    """Forward and backward of the same rows as ``ScaffoldGRPOTrainer`` does it."""
    _accumulate(trainer, count)

    def run() -> None:
        for part in trainer._collated(trainer._partitioned(rows)):
            trainer._compute_loss(trainer.model, part).backward()

    return run


def read_by_rollouts(trainer: Any, rows: Sequence[Any]) -> None:
    """Leave behind what sampling these rows would have: every row's tokens, read by the local backend."""
    from agentspec.llm.local.rows import Job
    from agentspec.types import Sampling

    llm = trainer.llm
    jobs = []
    for number, row in enumerate(rows):
        end = len(row.sequence) - row.sequence.mask[::-1].index(1) - 1
        jobs.append(Job(str(number), row.sequence.tokens[:end], Sampling(max_tokens=1)))
    if trainer._recorder is not None:
        trainer._recorder.clear()
    llm._engine.run(jobs)


def _accumulate(trainer: Any, count: int) -> None:
    """One optimiser step of ``count`` micro-batches, on-policy."""
    trainer.current_gradient_accumulation_steps = count
    trainer.args.gradient_accumulation_steps = count
    trainer.args.steps_per_generation = count


def trainers_for(model_name: str, adapter: str) -> tuple[Any, Any]:
    """A stock and one of our trainers over equal LoRA policies."""
    from datasets import Dataset
    from trl import GRPOConfig, GRPOTrainer

    from agentspec.types import Task
    from trainers.config import ScaffoldConfig
    from trainers.grpo import ScaffoldGRPOTrainer
    from trainers.policy import load_policy
    from trainers.rollouts import task_rows

    common: dict[str, Any] = {
        "output_dir": tempfile.mkdtemp(),
        "use_cpu": not torch.cuda.is_available(),
        "bf16": False,
        "report_to": [],
        "gradient_checkpointing": False,
        "num_generations": 2,
        "per_device_train_batch_size": 2,
        "loss_type": "dapo",
    }
    config = ScaffoldConfig(**common, model=model_name, adapter=adapter, packing="tree")
    built = []
    for kind in ("stock", "ours"):
        model, tokenizer = load_policy(config)
        with torch.no_grad():  # LoRA's second factor starts at zero, which would leave most gradients zero
            generator = torch.Generator().manual_seed(7)
            for name, parameter in model.named_parameters():
                if "lora_B" in name:
                    parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.01)
        if kind == "stock":
            args = GRPOConfig(**common)
            data = Dataset.from_list([{"prompt": "x"}] * 2)
            built.append(GRPOTrainer(model, lambda **_: [0.0], args, data, processing_class=tokenizer))
        else:
            data = Dataset.from_list(task_rows([Task("toy", 0), Task("toy", 1)]))
            built.append(ScaffoldGRPOTrainer(model, config, train_dataset=data, processing_class=tokenizer))
    for trainer in built:
        trainer.model.train()
    return built[0], built[1]


def measure(run: Callable[[], None]) -> dict[str, float]:
    """Seconds, of processor time too (per thread), and peak additional memory (MiB) of one call."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    with PeakMemory(device.type == "cuda") as memory:
        used, start = clock(device), time.perf_counter()
        run()
        used, seconds = clock(device) - used, time.perf_counter() - start
    return {"s": seconds, "cpu_s": used, "mb": memory.peak_mb}


def floor(update: Callable[[], None], logits: int, device: torch.device) -> float:
    """Seconds that the matrix products of an update, and writing and reading its logits both ways, take at best."""
    from torch.utils.flop_counter import FlopCounterMode

    def packed_linear(x: Any, *_: Any, out_shape: Any, **__: Any) -> int:
        return int(2 * torch.Size(out_shape).numel() * x[-1])

    with FlopCounterMode(display=False, custom_mapping={torch.ops.mkldnn._linear_pointwise: packed_linear}) as counter:
        update()
    best = ceilings(device)
    return counter.get_total_flops() / best.flops + 4 * 4 * logits / best.copied


def run_layout(layout: str, stock: Any, ours: Any, options: argparse.Namespace) -> dict[str, Any]:
    """All sides in turn on one layout."""
    from trainers.tree.trie import build_tree

    vocabulary = int(ours.model.get_input_embeddings().weight.shape[0])
    rows = make_rows(layout, options.rollouts, options.turns or LAYOUTS[layout], vocabulary)
    theirs, mine = stock_update(stock, rows, options.micro), our_update(ours, rows, options.ours_micro)
    alone = ours.llm and ours._recorder is not None
    sides = [("trl", stock, theirs), *([("alone", ours, mine)] if alone else []), ("ours", ours, mine)]
    measured: dict[str, list[dict[str, float]]] = {name: [] for name, *_ in sides}
    grads: dict[str, Gradients] = {}
    for _ in range(options.repeats):
        for name, trainer, update in sides:
            if name == "ours":
                read_by_rollouts(ours, rows)
            elif name == "alone":
                ours._recorder.clear()
            release()
            measured[name].append(measure(update))
            grads[name] = gradients(trainer)
    trained = sum(r.sequence.trained for r in rows)
    least = floor(mine, trained * vocabulary, next(ours.model.parameters()).device)  # what was read is still there
    gradients(ours)
    result: dict[str, Any] = {
        f"{name}_{key}": statistics.median(m[key] for m in runs)
        for name, runs in measured.items()
        for key in ("s", "cpu_s", "mb")
    }
    return result | {
        "ratio": result["trl_s"] / result["ours_s"],
        "cpu_ratio": result["trl_cpu_s"] / result["ours_cpu_s"],
        "alone_cpu_ratio": result["trl_cpu_s"] / result["alone_cpu_s" if alone else "ours_cpu_s"],
        "memory_ratio": result["trl_mb"] / max(1.0, result["ours_mb"]),
        "utilisation": least / result["ours_cpu_s"],
        **max((differences(g, grads["trl"]) for n, g in grads.items() if n != "trl"), key=lambda d: d["rel_grad_diff"]),
        **(errors(grads, in_float64(stock, stock_update(stock, rows, 1))) if options.reference else {}),
        "packing_ratio": sum(len(r.sequence) for r in rows) / len(build_tree([r.sequence.tokens for r in rows]).tokens),
        "rows": len(rows),
    }


def main() -> None:
    """Run all layouts and print a table, or JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--model", default="smollm2-135m")
    parser.add_argument("--adapter", default="smollm2-135m-courier", help="empty: a new one, on all layers")
    parser.add_argument("--rollouts", type=int, default=4, help="8 and 12 turns take stock TRL more than 24 GB")
    parser.add_argument("--turns", type=int, help="of every layout (default: 8, snapshot 6, supo 16)")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--reference", action="store_true", help="gradients of both sides beside those in float64")
    parser.add_argument("--micro", type=int, default=4, help="rows per micro-batch of stock TRL")
    parser.add_argument("--ours-micro", type=int, default=2, help="micro-batches of our update")
    parser.add_argument("--layouts", nargs="*", default=list(LAYOUTS))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    stock, ours = trainers_for(options.model, options.adapter)
    results = {}
    for layout in options.layouts:
        results[layout] = r = run_layout(layout, stock, ours, options)
        print(
            f"{layout:<13} ours {r['ours_s']:7.2f} s  trl {r['trl_s']:7.2f} s  ratio {r['ratio']:.2f}x  "
            f"(processor time {r['cpu_ratio']:.2f}x, alone {r['alone_cpu_ratio']:.2f}x)  "
            f"utilisation {r['utilisation']:.0%}  memory {r['memory_ratio']:.2f}x  "
            f"gradient difference {r['rel_grad_diff']:.1e} (of a parameter at most {r['max_rel_grad_diff']:.1e})  "
            f"packing {r['packing_ratio']:.2f}{_told(r)}",
            file=sys.stderr if options.json else sys.stdout,
            flush=True,
        )
    if options.json:
        print(json.dumps(results))


def _told(r: dict[str, Any]) -> str:
    """How far both sides are from the gradient in float64, if that was computed."""
    if "trl_error" not in r:
        return ""
    ours, trl = (f"{r[f'{s}_error']:.1e} (of a parameter at most {r[f'{s}_max_error']:.1e})" for s in ("ours", "trl"))
    return f"  from float64: ours {ours}, trl {trl}"


if __name__ == "__main__":
    main()
