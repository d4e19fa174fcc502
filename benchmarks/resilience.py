"""Runs that survive: killed at random points and resumed, and played in environments that fail.

    python -m benchmarks.resilience [--json] [--kills 20] [--episodes 200]

*Kills.* A run of six updates of a tiny random model (LoRA, the real recipe, a process of its own) is killed with
SIGKILL at a random point after its start, and started again with ``resume: true``. It counts as equal if the final
adapter is bitwise that of the uninterrupted run, and so are the receipts of all updates (but for the digests of records
that hold times) and, but for times, the logged metrics. Its records must pass the audit.

*Faults.* One update from 200 episodes, 50 groups of four, is made twice: with healthy environments, and with 10 % that
crash, 5 % that hang and 5 % that pay NaN. A group without a failure must contribute exactly the same rows.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.edits import findings

FAULTS = {"crash": 0.10, "hang": 0.05, "nan": 0.05}
GROUP = 4


def main() -> None:
    """Both parts; a summary or JSON."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--child", metavar="CONFIG", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        run_child(options.child)
        return
    with tempfile.TemporaryDirectory() as folder:
        result = kill_runs(Path(folder), options) | fault_run(Path(folder), options)
    if options.json:
        print(json.dumps(result))
        return
    print(
        f"killed {result['kills']} times, {result['resumed_equal']} resumed runs equal the uninterrupted one; "
        f"{result['audit_violations']} violations in their records"
    )
    print(
        f"{result['episodes']} episodes, {result['unscorable']} failed; of {result['healthy_groups']} groups without a "
        f"failure {result['healthy_groups_changed']} changed"
    )


# --- kills -----------------------------------------------------------------------------------------------------------


def run_child(config: str) -> None:
    """Train as the recipe does, from the last complete checkpoint if there is one."""
    import benchmarks.market  # noqa: F401  (registers the world)
    from trainers.arguments import parse_config
    from trainers.run import train

    train(parse_config([], default=config))


def write_model(folder: Path) -> Path:
    """A tiny random Qwen3 with its tokenizer, as a folder that the recipe can load."""
    from tests.tiny import tiny_model, tiny_tokenizer

    tokenizer = tiny_tokenizer()
    tiny_model(tokenizer).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    return folder


def write_config(path: Path, model: Path, run: Path, steps: int) -> Path:
    """The configuration of one run, as YAML (JSON is YAML)."""
    from benchmarks.market import MARKET

    config = {
        "model": str(model),
        "lora_r": 4,
        "output_dir": str(run),
        "environment": {"name": MARKET, "options": {"steps": 4, "words": 4, "menu": True}},
        "agent": {
            "reasoning": "direct",
            "memory": {"name": "summary", "every": 2, "summary_tokens": 8},
            "sampling": {"max_tokens": 8},
        },
        "train_calls": ["reasoning.*", "memory.summary"],
        "train_tasks": 8,
        "num_generations": 2,
        "per_device_train_batch_size": 2,
        "gradient_accumulation_steps": 2,
        "steps_per_generation": 4,  # two updates per round: kills fall inside rounds too
        "max_steps": steps,
        "save_steps": 1,
        "save_total_limit": 2,
        "learning_rate": 0.01,
        "lr_scheduler_type": "linear",
        "use_cpu": True,
        "bf16": False,
        "gradient_checkpointing": False,
        "logging_steps": 1,
        "report_to": "none",
        "disable_tqdm": True,
        "plots": False,
        "resume": True,
    }
    path.write_text(json.dumps(config), encoding="utf-8")
    return path


def kill_runs(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """The uninterrupted run, then one killed and resumed run per kill."""
    model = write_model(folder / "model")
    rng = random.Random(options.seed)
    config = write_config(folder / "whole.yaml", model, folder / "whole", options.steps)
    seconds = finish(config, folder / "whole")
    equal, points, killed, violations = 0, [], 0, 0
    while killed < options.kills:
        run = folder / f"run-{len(points)}"
        config = write_config(folder / f"{run.name}.yaml", model, run, options.steps)
        if not kill_after(config, run, rng.uniform(0.0, seconds)):
            continue  # it was over before: draw again
        killed += 1
        points.append(sorted(int(p.name.rpartition("-")[2]) for p in run.glob("checkpoint-*")))
        finish(config, run)
        same = outcome(run) == outcome(folder / "whole")
        equal += same
        found = findings(run)
        violations += len(found)
        for violation in found[:3]:
            print(f"kill {killed} with checkpoints {points[-1]}: {violation}", file=sys.stderr)
        if not same:
            print(f"kill {killed} with checkpoints {points[-1]}: the resumed run differs", file=sys.stderr)
    return {
        "kills": killed,
        "resumed_equal": equal,
        "audit_violations": violations,
        "checkpoints_at_kill": points,
    }


def start(config: Path, log: Path) -> subprocess.Popen[bytes]:
    """The run as a process."""
    command = [sys.executable, "-m", "benchmarks.resilience", "--child", str(config)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    with open(log, "ab") as output:
        return subprocess.Popen(command, stdout=output, stderr=output, env=environment)


def finish(config: Path, run: Path) -> float:
    """Run to the end; seconds from the manifest of a new run (training begins) to the final weights.

    Raises:
        RuntimeError: the run failed.
    """
    log = run.with_suffix(".log")
    process = start(config, log)
    began = wait_for(run / "manifest.json", process)
    ended = wait_for(run / "adapter_model.safetensors", process)
    if process.wait() != 0:
        raise RuntimeError(f"the run in {run} failed:\n{log.read_text(encoding='utf-8', errors='replace')[-3000:]}")
    return ended - began


def kill_after(config: Path, run: Path, delay: float) -> bool:
    """Start a run and kill it ``delay`` seconds after training began; False if it had ended by then."""
    process = start(config, run.with_suffix(".log"))
    wait_for(run / "manifest.json", process)
    time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def wait_for(path: Path, process: subprocess.Popen[bytes]) -> float:
    """Time at which ``path`` appears, or the process ends."""
    while not path.exists() and process.poll() is None:
        time.sleep(0.01)
    return time.perf_counter()


def outcome(run: Path) -> tuple[Any, ...]:
    """What must be equal: the adapter bit by bit, every receipt, and the metrics but for times."""
    from safetensors.torch import load_file

    from agentspec.records.log import RunLog

    weights = load_file(run / "adapter_model.safetensors")
    log = RunLog(run)
    metrics = [{k: v for k, v in r.items() if "time" not in k} for r in log.read("metrics.jsonl")]
    receipts = [{k: v for k, v in r.items() if k != "chain"} for r in log.read("updates.jsonl")]
    return {n: w.numpy().tobytes() for n, w in weights.items()}, receipts, metrics


# --- faults ----------------------------------------------------------------------------------------------------------


class Worlds:
    """Makes environments, of which given ones of each task are broken."""

    def __init__(self, faults: dict[tuple[int, int], str]) -> None:
        self._faults = faults
        self._made: Counter[int] = Counter()
        self._lock = threading.Lock()

    def __call__(self, task: Any) -> Any:
        from benchmarks.market import MarketEnv

        with self._lock:
            number = self._made[task.seed]
            self._made[task.seed] += 1
        return MarketEnv(**task.options, fault=self._faults.get((task.seed, number), ""))


def one_update(folder: Path, episodes: int, faults: dict[tuple[int, int], str]) -> tuple[int, set[int], dict[int, Any]]:
    """One update: how many episodes failed, in which groups, and the rows of each group."""
    from datasets import Dataset

    from agentspec.types import Task
    from benchmarks.market import MARKET
    from tests.tiny import tiny_model, tiny_tokenizer
    from trainers.config import ScaffoldConfig
    from trainers.grpo import ScaffoldGRPOTrainer
    from trainers.rollouts import task_rows

    tokenizer = tiny_tokenizer()
    config = ScaffoldConfig(
        output_dir=str(folder),
        agent={"reasoning": "direct", "sampling": {"max_tokens": 8}},
        per_device_train_batch_size=episodes // 2,
        gradient_accumulation_steps=2,
        num_generations=GROUP,
        max_steps=1,
        env_timeout_s=2.0,
        save_strategy="no",
        report_to=[],
        use_cpu=True,
        bf16=False,
        gradient_checkpointing=False,
        logging_steps=1,
        disable_tqdm=True,
        shuffle_dataset=False,
    )
    tasks = [Task(MARKET, seed, {"steps": 3, "words": 2, "menu": True}) for seed in range(episodes // GROUP)]
    trainer = ScaffoldGRPOTrainer(
        tiny_model(tokenizer),
        config,
        train_dataset=Dataset.from_list(task_rows(tasks)),
        processing_class=tokenizer,
        make_env=Worlds(faults),
    )
    with contextlib.redirect_stdout(sys.stderr):  # the trainer prints its metrics; stdout is for the result
        trainer.train()
    (record,) = trainer.run_log.read("updates.jsonl")
    failed = [i for i, value in enumerate(record["returns"]) if value is None]
    rows: dict[int, Any] = {}
    for row in record["rows"]:
        rows.setdefault(row["episode"] // GROUP, []).append((row["episode"], row["advantage"], row["digest"]))
    return len(failed), {i // GROUP for i in failed}, {g: sorted(r) for g, r in rows.items()}


def fault_run(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """The update with and without faults, compared group by group."""
    episodes = options.episodes - options.episodes % GROUP
    places = [(task, number) for task in range(episodes // GROUP) for number in range(GROUP)]
    random.Random(options.seed).shuffle(places)
    faults: dict[tuple[int, int], str] = {}
    for name, share in FAULTS.items():
        count = round(share * episodes)
        faults |= {place: name for place in places[len(faults) : len(faults) + count]}
    _, _, healthy = one_update(folder / "healthy", episodes, {})
    unscorable, broken, rows = one_update(folder / "faulty", episodes, faults)
    groups = [g for g in range(episodes // GROUP) if g not in broken]
    return {
        "episodes": episodes,
        "faults": len(faults),
        "unscorable": unscorable,
        "healthy_groups": len(groups),
        "healthy_groups_changed": sum(rows.get(g) != healthy.get(g) for g in groups),
    }


if __name__ == "__main__":
    main()
