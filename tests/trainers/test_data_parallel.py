"""Invariant 5: two processes take the same step as one process on the same global batch.

``accelerate launch`` starts this file twice, with one and with two processes (gloo, CPU). Every case trains the tiny
model on the same global batch of eight rollouts; the weights after two steps must agree.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

import torch
from datasets import Dataset
from peft import LoraConfig, get_peft_model
from safetensors.torch import load_file, save_file
from transformers import TrainerCallback

from agentspec.episode import Job
from agentspec.records.log import RunLog
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from tests.tiny import tiny_model, tiny_tokenizer
from tests.toy_env import TOY
from tests.trainers.builders import call, episode, instead_of_playing
from trainers import grpo as grpo_module
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.counterfactuals import FOLDER as COUNTERFACTUALS
from trainers.distributed import end_process
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.resume import load_state
from trainers.rollouts import collect, task_rows

ROOT = Path(__file__).resolve().parents[2]
ROLLOUTS = 8

# Four rollouts per process: with eight per task a group spans both processes; with four, each process has one group.
CASES: dict[str, dict[str, Any]] = {
    "tree": {"num_generations": 8},
    "chunks": {"num_generations": 8, "tokens_per_forward": 30},
    "padded": {"num_generations": 8, "packing": "padded"},
    "per_token": {"num_generations": 8, "estimator": "reward_to_go"},
    # The second task pays everybody alike: the process that holds its group has nothing to learn.
    "idle": {"num_generations": 4, "max_steps": 1, "shuffle_dataset": False},
    "failed": {"num_generations": 8},
    # A mean over rows: the process with fewer of them has more padding.
    "rows": {"num_generations": 8, "loss_type": "grpo"},
    "kl": {"num_generations": 8, "beta": 0.1},
    "played": {"num_generations": 8},
    # The second round starts from lessons that the best rollout of the first wrote, on whichever process it was.
    "carried": {"num_generations": 8, "memory_carry": "best", "save_strategy": "steps", "save_steps": 1},
    "cut": {"num_generations": 8, "save_strategy": "steps", "save_steps": 1, "steps_per_generation": 4},
    # Writes to memory are credited by episodes beside the batch; the pairs of a group span both processes.
    "local": {"num_generations": 8, "max_steps": 1, "write_credit": "local"},
    "ablation": {"num_generations": 8, "max_steps": 1, "write_credit": "ablation"},
}
WRITES = ("local", "ablation")
PLAYED = ("played", "carried", "cut", *WRITES)


def built_episode(case: str, job: Job) -> Trajectory:
    """1 to 3 rows and one return per (task, rollout), the same in whichever process it is played."""
    number = 8 * job.task.seed + job.rollout
    g = torch.Generator().manual_seed(number)
    calls = []
    for r in range(1 + (number * 5) % 7 % 3):
        prompt = torch.randint(0, 250, (3 + number % 4,), generator=g).tolist()
        answer = torch.randint(0, 250, (2 + (number + r) % 3,), generator=g).tolist()
        calls.append(call(r, [r, *prompt], answer))
    value = 3.0 if case == "idle" and job.task.seed % 2 else float((7 * number) % 5)
    status = "failed" if case == "failed" and job.rollout in (1, 6) else "completed"
    return episode(calls, [value], rollout=job.rollout, status=status)


def make_trainer(folder: Path, case: str, **changes: Any) -> ScaffoldGRPOTrainer:
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    agent = {"reasoning": "direct", "memory": {"name": "summary", "every": 2, "summary_tokens": 4}}
    settings: dict[str, Any] = {
        "output_dir": str(folder),
        "agent": {**agent, "sampling": {"max_tokens": 8}},
        "train_calls": ["reasoning.*", "memory.summary"],
        "per_device_train_batch_size": 4 // processes,
        "gradient_accumulation_steps": 2,
        "max_steps": 2,
        "learning_rate": 1e-2,
        "lr_scheduler_type": "constant",
        "optim": "sgd",
        "report_to": [],
        "use_cpu": True,
        "bf16": False,
        "gradient_checkpointing": False,
        "save_strategy": "no",
        "logging_steps": 1,
        "disable_tqdm": True,
        **CASES[case],
        **changes,
    }
    if case == "carried":
        sampling = {"max_tokens": 8}
        settings["agent"] = {"reasoning": "direct", "reflection": "reflexion", "scope": "run", "sampling": sampling}
        settings["train_calls"] = ["reasoning.*"]
    tokenizer = tiny_tokenizer()
    tasks = [Task(TOY, seed, {"steps": 5, "menu": True}) for seed in range(4)]
    model = tiny_model(tokenizer)
    if case == "kl":  # the reference is the base under the adapter
        model = get_peft_model(model, LoraConfig(r=2, lora_alpha=4, target_modules=["q_proj", "v_proj"]))
    return ScaffoldGRPOTrainer(
        model,
        ScaffoldConfig(**settings),
        train_dataset=Dataset.from_list(task_rows(tasks)),
        processing_class=tokenizer,
    )


class _Stop(TrainerCallback):
    def on_step_end(self, args: Any, state: Any, control: Any, **_: Any) -> Any:
        control.should_training_stop = True
        return control


def run_cases(out: Path, processes: int) -> None:
    """What every process does: train each case; the main process writes the weights."""
    for case in CASES:
        built = case not in PLAYED
        grpo_module.collect = (  # type: ignore[assignment]
            instead_of_playing(lambda jobs, case=case: [built_episode(case, j) for j in jobs]) if built else collect
        )
        trainer = make_trainer(out / case, case)
        assert trainer.accelerator.num_processes == processes
        if case == "cut":  # stopped in the middle of a round, then resumed by a new trainer
            trainer.add_callback(_Stop())
            trainer.train()
            trainer = make_trainer(out / case, case)
            trainer.train(resume_from_checkpoint=str(out / case / "checkpoint-1"))
        else:
            trainer.train()
        if trainer.accelerator.is_main_process:
            weights = trainer.accelerator.unwrap_model(trainer.model).state_dict()
            kept = {n: w.clone().contiguous() for n, w in weights.items()}
            save_file(kept, out / f"{case}.safetensors")
        trainer.accelerator.wait_for_everyone()


def launch(out: Path, processes: int) -> Path:
    out.mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # With `--cpu`, accelerate starts a single process whatever it is asked for (unless there is MPI). With
    # `--multi_gpu` it starts as many as asked; without a GPU they are processes on the CPU that talk through gloo.
    command = [sys.executable, "-m", "accelerate.commands.launch", *(["--multi_gpu"] if processes > 1 else ["--cpu"])]
    command += ["--num_processes", str(processes), "--num_machines", "1", "--mixed_precision", "no"]
    command += ["--dynamo_backend", "no", "--main_process_port", str(port)]
    command += ["-m", "tests.trainers.test_data_parallel", str(out), str(processes)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return out


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Path]]:
    """Folders of the run with one process and of the run with two."""
    folder = tmp_path_factory.mktemp("parallel")
    yield launch(folder / "one", 1), launch(folder / "two", 2)


@pytest.mark.parametrize("case", CASES)
def test_two_processes_take_the_step_of_one(runs: tuple[Path, Path], case: str) -> None:
    one, two = (load_file(folder / f"{case}.safetensors") for folder in runs)
    if case == "kl":
        moved = max(w.abs().max().item() for n, w in one.items() if "lora_B" in n)  # these start at zero
    else:
        start = tiny_model(tiny_tokenizer()).state_dict()
        moved = max((one[n] - start[n]).abs().max().item() for n in one)
    assert moved > 1e-5
    assert max((one[n] - two[n]).abs().max().item() for n in one) < 1e-6


@pytest.mark.parametrize("case", ["tree", "failed", *PLAYED])
def test_the_logs_of_two_processes_are_those_of_one(runs: tuple[Path, Path], case: str) -> None:
    one, two = (RunLog(folder / case).read("updates.jsonl") for folder in runs)
    assert len(one) == len(two) > 0
    for a, b in zip(one, two, strict=True):
        assert a["episodes"] == b["episodes"] and a["returns"] == b["returns"]
        assert [r["digest"] for r in a["rows"]] == [r["digest"] for r in b["rows"]]
        assert a["denominator"] == b["denominator"] > 0
    one, two = (RunLog(folder / case).read("metrics.jsonl") for folder in runs)
    for a, b in zip(one, two, strict=True):
        assert a.get("reward") == pytest.approx(b.get("reward"))  # none in the second half of a round
        assert a["grad_norm"] == pytest.approx(b["grad_norm"], rel=1e-4)


@pytest.mark.parametrize("case", ["played", "cut", *WRITES])
def test_the_audit_reads_the_episodes_of_every_process(runs: tuple[Path, Path], case: str) -> None:
    files = {p.name for p in (runs[1] / case / "trajectories").glob("*.jsonl")}
    assert {"000000.jsonl", "000000.rank1.jsonl"} <= files
    receipts = list(audit(runs[1] / case))
    assert receipts and all(r.episodes % ROLLOUTS == 0 and r.trained for r in receipts)
    assert not [v for r in receipts for v in r.violations]
    # Rollouts of a group that spans processes are different rollouts of one task.
    record = RunLog(runs[1] / case).read("updates.jsonl")[0]
    assert len(set(record["episodes"])) == len(record["episodes"])


def test_every_process_carries_the_same_memory(runs: tuple[Path, Path]) -> None:
    checkpoint = runs[1] / "carried" / "checkpoint-1"
    first, second = load_state(checkpoint), load_state(checkpoint, 1)
    alone = load_state(runs[0] / "carried" / "checkpoint-1")
    assert first is not None and second is not None and alone is not None
    assert first.memory is not None and first.memory == second.memory == alone.memory


@pytest.mark.parametrize("case", WRITES)
def test_writes_earn_the_same_on_two_processes_as_on_one(runs: tuple[Path, Path], case: str) -> None:
    played, updates = [], []
    for folder in runs:
        log = RunLog(folder / case)
        records = [json.loads(line) for p in log_files(folder / case) for line in p.read_text().splitlines()]
        played.append(records)
        updates.append(log.read("updates.jsonl"))
    # Eight twins, or one write of each of the eight episodes re-rolled twice with and twice without it.
    assert [len(p) for p in played] == [8 if case == "ablation" else 32] * 2
    assert len(log_files(runs[1] / case)) == 2  # each process played those of its own episodes
    one, two = ([sum(step["reward"] for step in r["steps"]) for r in records] for records in played)
    assert one == two and len(set(one)) > 1
    advantages = [[r["advantage"] for u in us for r in u["rows"]] for us in updates]
    assert advantages[0] == advantages[1]
    assert len({a for row in advantages[0] if isinstance(row, list) for a in row}) > 1  # some write earned something


def log_files(run: Path) -> list[Path]:
    """The files of a run's counterfactuals, in the order of the processes."""
    return sorted((run / COUNTERFACTUALS).glob("*.jsonl"))


def test_ranks_had_different_numbers_of_rows(runs: tuple[Path, Path]) -> None:
    rows = [r["episode"] for r in RunLog(runs[1] / "tree").read("updates.jsonl")[0]["rows"]]
    first = sum(e < ROLLOUTS // 2 for e in rows)
    assert first != len(rows) - first
    assert json.loads((runs[1] / "tree" / "manifest.json").read_text())["config"]["num_generations"] == 8


if __name__ == "__main__":
    run_cases(Path(sys.argv[1]), int(sys.argv[2]))
    end_process()
