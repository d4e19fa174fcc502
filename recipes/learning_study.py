"""Does it learn? Train each recipe with several seeds, then play held-out tasks before and after, under every scaffold.

    python -m recipes.learning_study --configs recipes/configs/study_grpo.yaml recipes/configs/study_supo.yaml \\
        --seeds 0 1 2 --out runs/study

Every run is a process of its own (`OUT/NAME-sSEED`) and goes on where it stopped; so does the evaluation. What comes
out: `study.md` (gains per training seed and over all of them), `results.md` (the whole matrix), `curves.png`.
All configs must name the same model, warm start and world: then one starting policy is the baseline of all.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recipes.common import CONFIGS, run_recipe, unit

if TYPE_CHECKING:
    from eval.statistics import Estimate

START = "start"


def main() -> None:
    """Train what is not trained, evaluate what is not evaluated, write the report."""
    from trainers.arguments import parse_config

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0], allow_abbrev=False)
    parser.add_argument("--configs", nargs="+", required=True, help="training configurations, one per method")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="training seeds")
    parser.add_argument("--out", default="runs/study", help="folder of all runs and of the report")
    parser.add_argument("--no-train", action="store_true", help="evaluate the runs that are there")
    options = parser.parse_args()
    out = Path(options.out)
    configs = {
        Path(path).stem: parse_config(["--config", path], default=CONFIGS / "cpu.yaml") for path in options.configs
    }
    check(configs)
    runs = {name: {seed: out / f"{name}-s{seed}" for seed in options.seeds} for name in configs}
    if not options.no_train:
        for path, (_, folders) in zip(options.configs, runs.items(), strict=True):
            for seed, folder in folders.items():
                train(path, seed, folder)
    report(configs, runs, out)


def check(configs: Mapping[str, Any]) -> None:
    """One baseline serves all configurations.

    Raises:
        SpecError: two of them have the same name, or differ in model, adapter, world or held-out tasks.
    """
    from agentspec.registry import SpecError

    first, *others = configs.items()
    for name, config in others:
        for field in ("model", "adapter", "environment", "eval_tasks", "eval_sampling"):
            mine, theirs = getattr(config, field), getattr(first[1], field)
            if mine != theirs:
                raise SpecError(
                    f"{field} is {mine!r} in {name} and {theirs!r} in {first[0]}; a study compares like with like"
                )


def train(path: str, seed: int, folder: Path) -> None:
    """One training run in a process of its own; a finished one is only loaded.

    Raises:
        SystemExit: it failed.
    """
    command = [sys.executable, "-m", "agentspec.cli", "train", "grpo_delivery", "--config", path]
    command += ["--seed", str(seed), "--output_dir", str(folder), "--resume", "true"]
    print(f"{folder}: {' '.join(command)}", file=sys.stderr, flush=True)
    if subprocess.run(command, check=False).returncode:
        raise SystemExit(f"{folder}: training failed (see above); the same command goes on from its last checkpoint")


def report(configs: Mapping[str, Any], runs: Mapping[str, Mapping[int, Path]], out: Path) -> None:
    """Play the matrix and write tables and curves."""
    from agentspec.files import write_atomic
    from agentspec.llm.models import resolve_adapter
    from agentspec.tasks import make_tasks
    from eval.matrix import Policy, evaluate
    from eval.plots import learning_curves
    from eval.tables import write_report
    from trainers.config import agent_spec
    from trainers.run_folder import METRICS
    from trainers.runlog import RunLog

    config = next(iter(configs.values()))
    name, options = config.world
    specs = [agent_spec(s) for c in configs.values() for s in (c.spec.to_data(), *(c.eval_specs or []))]
    start = resolve_adapter(config.adapter) if config.adapter else ""
    policies = [Policy(START, model=config.model, adapter=start)]
    for method, folders in runs.items():
        policies += [Policy(f"{method}-s{seed}", config.model, str(folder)) for seed, folder in folders.items()]
    policies += [Policy("rule_based"), Policy("random")]
    rows = evaluate(
        policies,
        {s.label: s for s in specs},
        make_tasks(name, options, config.eval_tasks, split="test"),
        out=out,
        sampling=config.evaluation_sampling,
        on_row=lambda row: print(row["policy"], row["scaffold"], row["task"], row.get("return"), file=sys.stderr),
    )
    write_report(rows, out)
    own = {method: c.spec.label for method, c in configs.items()}
    write_atomic(out / "study.md", gains(rows, {m: list(f) for m, f in runs.items()}, own))
    logs = {m: [RunLog(f).read(METRICS) for f in folders.values()] for m, folders in runs.items()}
    learning_curves(logs, out / "curves.png", unit=unit(config))
    print((out / "study.md").read_text())


def gains(rows: Sequence[Mapping[str, Any]], seeds: Mapping[str, Sequence[int]], own: Mapping[str, str]) -> str:
    """Markdown: what each training run gained over the start, on the same tasks, under every scaffold.

    Args:
        rows: of the evaluation.
        seeds: method -> training seeds.
        own: method -> label of the scaffold it was trained in.
    """
    from agentspec.metrics import primary_metric
    from eval.statistics import compare_runs, corrected
    from eval.tables import table, values_by_task

    primary = primary_metric(rows)
    metric, digits = primary.name, primary.digits
    scaffolds = list(dict.fromkeys(row["scaffold"] for row in rows))
    cells = {
        (policy, s): values_by_task([r for r in rows if (r["policy"], r["scaffold"]) == (policy, s)], metric)
        for policy in dict.fromkeys(row["policy"] for row in rows)
        for s in scaffolds
    }
    compared: list[tuple[str, str, Mapping[str, float], list[Mapping[str, float]]]] = []
    for method, numbers in seeds.items():
        for scaffold in scaffolds:
            before, *after = (cells[p, scaffold] for p in (START, *(f"{method}-s{n}" for n in numbers)))
            where = f"{scaffold} (its own)" if scaffold == own[method] else scaffold
            compared.append((method, where, before, after))
    gains_over_runs = corrected([compare_runs(after, [before]) for _, _, before, after in compared])
    body = [
        [method, where, *_compared(before, after, gain, digits)]
        for (method, where, before, after), gain in zip(compared, gains_over_runs, strict=True)
    ]
    header = [
        "trained with",
        "evaluated in",
        "before",
        "after (all seeds)",
        "gain (all seeds)",
        "p",
        "verdict",
        "gain per seed",
        "tasks",
    ]
    lines = [
        f"# {primary.heading} before and after training",
        "",
        "Greedy, on held-out tasks, paired by task. 95 % t intervals: per seed over tasks (that checkpoint only),",
        "for all seeds over training runs. p-values of the gains over runs, Holm over the table; above 0.05 is a tie.",
        "",
        *table(header, body),
        "",
    ]
    return "\n".join(lines)


def _compared(
    before: Mapping[str, float], after: Sequence[Mapping[str, float]], gain: Estimate, digits: int
) -> list[str]:
    """Cells of one row, from values by task of the start and of each run; a task that one of them lacks is out."""
    from eval.statistics import mean_interval, runs_mean
    from eval.tables import show

    tasks = [t for t in before if all(t in values for values in after)]
    gained = [[values[t] - before[t] for t in tasks] for values in after]
    start = mean_interval([before[t] for t in tasks])
    end = runs_mean([{t: values[t] for t in tasks} for values in after])
    each = ", ".join(show(mean_interval(g), digits) for g in gained)
    verdict = "tie" if gain.tie() else "gain" if gain.mean > 0 else "loss"
    p = "–" if math.isnan(gain.p) else f"{gain.p:.3f}"
    return [show(start, digits), show(end, digits), show(gain, digits), p, verdict, each, str(len(tasks))]


if __name__ == "__main__":
    run_recipe(main)
