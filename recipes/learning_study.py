"""Does it learn, and where? Train arms in their scaffolds with several seeds, then play all policies in all scaffolds.

    python -m recipes.learning_study --config recipes/configs/transfer_minigrid_cpu.yaml --dry-run
    python -m recipes.learning_study --config recipes/configs/transfer_minigrid_cpu.yaml --jobs 2

One YAML says everything (`eval.study.plan`); files may extend each other. Every training run is a process of its own
under `OUT/runs` and goes on where it stopped, the evaluation goes on from its store: the same command again does what
is left. Then it audits all runs and writes `OUT/report` (also `agentspec report OUT --to FOLDER`).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from recipes.common import CONFIGS, run_recipe

if TYPE_CHECKING:
    from eval.study import Study


def main() -> None:
    """Train what is not trained, evaluate what is not evaluated, audit, report."""
    from agentspec.extends import read_extended
    from agentspec.registry import SpecError
    from eval.study import read_study
    from eval.study.training import train_all

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
    tasks = held_out(study, configs, warm)
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


def held_out(study: Study, configs: Mapping[str, Any], warm: Any) -> dict[str, Any]:
    """The tasks that all policies play: different episodes, on which neither an arm nor its start is trained.

    Raises:
        SpecError: the world has too few.
    """
    from agentspec.tasks import make_tasks, unseen_tasks

    every = [*configs.values(), *([warm] if warm else [])]
    worlds = [(*config.world, config.train_tasks) for config in every]
    worlds += [world for config in every for world in begun_with(config.adapter)]
    trained = [task for name, options, count in worlds for task in make_tasks(name, options, count)]
    name, options = every[0].world
    return {name: unseen_tasks(name, options, study.tasks, trained)}


def begun_with(adapter: str) -> Iterator[tuple[str, dict[str, Any], int]]:
    """World and number of tasks that a run whose folder `adapter` is was trained on, and the runs before it."""
    from agentspec.records.folder import MANIFEST
    from trainers.ahead import check_world

    while adapter and (file := Path(adapter) / MANIFEST).is_file():
        config = json.loads(file.read_text())["config"]
        yield *check_world(config["environment"] or "deliverybench"), config["train_tasks"]
        adapter = config["adapter"]


def evaluate_all(study: Study, configs: Mapping[str, Any], tasks: Mapping[str, Any]) -> None:
    """Play the matrix, audit every run, write `study.json` and the report."""
    from agentspec.files import append_lines, write_atomic
    from agentspec.llm.models import resolve_adapter
    from eval.live import LiveTable
    from eval.matrix import evaluate
    from eval.report import build_report, write_files
    from eval.study.cost import cpu_seconds

    out, before, config = Path(study.out), cpu_seconds(), next(iter(configs.values()))
    start = str(resolve_adapter(config.adapter)) if config.adapter else ""
    policies = study.policies(config.model, start, lora=bool(config.lora_r or start))
    evaluate(policies, study.scaffolds, tasks, out=out, settings=study.settings, twins=True, observer=LiveTable())
    append_lines(out / "costs.jsonl", {"what": "evaluation", "cpu_s": round(cpu_seconds() - before, 1)})
    rollouts = {name: c.generation_batch_size for name, c in configs.items()}
    write_atomic(out / "study.json", study.record(rollouts, {run: receipt(study.folder(*run)) for run in study.ended}))
    for path in write_files(build_report(out, title=out.name), out / "report"):
        print(path)


def receipt(folder: Path) -> dict[str, Any]:
    """What the audit of a run says."""
    from agentspec.files import file_digest
    from trainers.audit import audit

    found = list(audit(folder))
    told = {"violations": [v for f in found for v in f.violations], "notes": [n for f in found for n in f.notes]}
    return {"updates": sum(f.round is not None for f in found), "head": file_digest(folder / "seal.json"), **told}


def planned(study: Study, configs: Mapping[str, Any], warm: Any, tasks: Mapping[str, Any]) -> str:
    """Runs, episodes, hours and the smallest difference that would be found."""
    from eval.study.cost import Rounds, estimate

    config = next(iter(configs.values()))
    rounds = {
        name: Rounds(c.max_steps * c.gradient_accumulation_steps // c.steps_per_generation, c.generation_batch_size)
        for name, c in configs.items()
    }
    warmup = (warm.train_tasks, warm.num_train_epochs) if warm else (0, 0.0)
    lora = bool(config.lora_r or config.adapter)
    return estimate(study, config.model, tasks, rounds, start=config.adapter, lora=lora, warmup=warmup)


if __name__ == "__main__":
    run_recipe(main)
