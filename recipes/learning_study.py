"""Does it learn, and where? Train arms in their scaffolds with several seeds, then play all policies in all scaffolds.

    python -m recipes.learning_study --config recipes/configs/transfer_minigrid_cpu.yaml --dry-run
    python -m recipes.learning_study --config recipes/configs/transfer_minigrid_cpu.yaml --jobs 2

One YAML says everything (`eval.study.plan`); files may extend each other. Every training run is a process of its own
under `OUT/runs` and goes on where it stopped, the evaluation goes on from its store: the same command again does what
is left. Then it audits all runs and writes `OUT/report` (also `agentspec report OUT --to FOLDER`).
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from recipes.common import CONFIGS, run_recipe

if TYPE_CHECKING:
    from eval.study import Study

RECIPES = {"grpo": "grpo_delivery", "supo": "supo_delivery", "memory": "grpo_memory"}
"""`trainer` of an arm -> the recipe that trains it."""


def main() -> None:
    """Train what is not trained, evaluate what is not evaluated, audit, report."""
    from agentspec.extends import read_extended
    from agentspec.registry import SpecError
    from eval.study import read_study
    from eval.study.playing import held_out

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0], allow_abbrev=False)
    parser.add_argument("--config", metavar="FILE", help="the study, or the name of one that ships")
    parser.add_argument("--out", metavar="DIR", help="folder of runs and report (default: the study's `out`)")
    parser.add_argument("--dry-run", action="store_true", help="print runs, episodes and estimated hours")
    parser.add_argument("--no-train", action="store_true", help="evaluate the runs that have ended")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="training runs side by side, one thread each")
    options = parser.parse_args()
    if not options.config:
        shipped = ", ".join(sorted(path.stem for path in CONFIGS.glob("transfer_*.yaml")))
        raise SpecError(f"a study is one YAML file: give --config FILE, or the name of one that ships ({shipped})")
    data = read_extended(options.config, CONFIGS)
    study = read_study({**data, "out": options.out} if options.out else data)
    configs = {name: arm_config(study, name) for name in study.arms}
    warm = written(study, "warmup", study.warmup, False) if study.warmup else None
    tasks = held_out(study.tasks, [*configs.values(), *([warm] if warm else [])])
    if options.dry_run:
        print(planned(study, configs, warm, tasks))
        return
    if not options.no_train:
        train_all(study, max(1, options.jobs))
    evaluate_all(study, configs, tasks)


def written(study: Study, name: str, data: Mapping[str, Any], begun: bool) -> Any:
    """The configuration `data`, kept as a file that its runs are started with.

    Raises:
        SpecError: what is wrong with it, or (`begun`) there are runs of another one.
    """
    from agentspec.files import write_atomic
    from agentspec.registry import SpecError
    from trainers.arguments import parse_config

    path, text = Path(study.out) / "configs" / f"{name}.yaml", yaml.safe_dump(dict(data))
    if begun and path.is_file() and path.read_text() != text:
        raise SpecError(f"{path}: {name!r} has runs of another configuration; choose another `out`, or remove them")
    write_atomic(path, text)
    return parse_config(["--config", str(path)], default=CONFIGS / "cpu.yaml")


def arm_config(study: Study, name: str) -> Any:
    """The training configuration of an arm, checked.

    Raises:
        SpecError: as `written`, or its trainer would change the scaffold.
    """
    from agentspec.registry import SpecError
    from trainers.presets import as_memory, as_supo

    arm = study.arms[name]
    agent = study.scaffolds[arm.scaffold]
    start = {"adapter": str(study.start)} if study.start else {}
    data = {**study.train, **start, **arm.fields, "agent": agent.to_data()}
    config = written(study, name, data, name in dict(study.begun))
    config = {"supo": as_supo, "memory": as_memory}.get(arm.trainer, lambda given: given)(config)
    config.check()
    if config.spec.memory != agent.memory:
        raise SpecError(f"arm {name!r}: {arm.trainer} trains in memory {config.spec.memory}, {arm.scaffold!r} has none")
    return config


def train_all(study: Study, jobs: int) -> None:
    """The warm start, then every training run that has not ended, `jobs` at a time.

    Raises:
        SystemExit: one failed; those that are under way go on to their ends.
    """
    from agentspec.records.folder import MANIFEST

    if study.start and not (study.start / MANIFEST).is_file():  # it is written last
        process(study, "warm start", "sft_warmup", "warmup", study.start)

    def one(arm: str, seed: int) -> None:
        recipe, more = RECIPES[study.arms[arm].trainer], ("--seed", str(seed), "--resume", "true")
        process(study, f"train {arm}", recipe, arm, study.folder(arm, seed), *more)

    with ThreadPoolExecutor(jobs) as pool:
        started = [pool.submit(one, *run) for run in study.runs if run not in study.ended]
        try:
            for run in started:
                run.result()
        finally:
            pool.shutdown(cancel_futures=True)


def process(study: Study, what: str, recipe: str, config: str, folder: Path, *more: str) -> None:
    """One recipe in a process of its own; what it took is a line of `costs.jsonl`.

    Raises:
        SystemExit: it failed.
    """
    from agentspec.cli.train import in_a_process
    from agentspec.files import append_lines
    from eval.report.training import COSTS

    file = Path(study.out) / "configs" / f"{config}.yaml"
    seconds = in_a_process(recipe, "--config", str(file), "--output_dir", str(folder), *more)
    append_lines(Path(study.out) / COSTS, {"what": what, "run": folder.name, "cpu_s": round(seconds, 1)})


def evaluate_all(study: Study, configs: Mapping[str, Any], tasks: Mapping[str, Any]) -> None:
    """Play the matrix, audit every run, write `study.json` and the report."""
    from agentspec.llm.models import resolve_adapter
    from eval.study.playing import conclude, play

    config = next(iter(configs.values()))
    start = str(resolve_adapter(config.adapter)) if config.adapter else ""
    play(study, study.policies(config.model, start, lora=bool(config.lora_r or start)), tasks)
    audits = {run: receipt(study.folder(*run)) for run in study.ended}
    for path in conclude(study, {name: c.generation_batch_size for name, c in configs.items()}, audits):
        print(path)


def receipt(folder: Path) -> dict[str, Any]:
    """What the audit of a run says."""
    from agentspec.records.folder import SEAL, digest_of
    from trainers.audit import audit

    found = list(audit(folder))
    told = {"violations": [v for f in found for v in f.violations], "notes": [n for f in found for n in f.notes]}
    return {"updates": sum(f.round is not None for f in found), "head": digest_of(folder / SEAL), **told}


def planned(study: Study, configs: Mapping[str, Any], warm: Any, tasks: Mapping[str, Any]) -> str:
    """Runs, episodes, hours and the smallest difference that would be found."""
    from eval.study.cost import Rounds, estimate

    config = next(iter(configs.values()))
    rounds = {name: Rounds(c.rounds, c.generation_batch_size) for name, c in configs.items()}
    warmup = (warm.train_tasks, warm.num_train_epochs) if warm else (0, 0.0)
    lora = bool(config.lora_r or config.adapter)
    return estimate(study, config.model, tasks, rounds, start=config.adapter, lora=lora, warmup=warmup)


if __name__ == "__main__":
    run_recipe(main)
