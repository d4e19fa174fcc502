"""Training runs of the tiny model in the toy environment: seconds, no data, everything real but the size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from datasets import Dataset

from agentspec.types import Task
from tests.tiny import tiny_model, tiny_tokenizer
from tests.toy_env import TOY
from tests.trainers.builders import CPU_RUN
from trainers.config import ScaffoldConfig
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.rollouts import task_rows


def toy_tasks(count: int = 4, **options: Any) -> list[Task]:
    return [Task(TOY, seed, {"steps": 3, "menu": True, **options}) for seed in range(count)]


def toy_trainer(
    folder: Path, tasks: Sequence[Task] | None = None, *, make_env: Callable[[Task], Any] | None = None, **changes: Any
) -> ScaffoldGRPOTrainer:
    """Two tasks of two rollouts per update, three actions per episode, two updates."""
    settings: dict[str, Any] = {
        "output_dir": str(folder),
        "agent": {"reasoning": "direct", "sampling": {"max_tokens": 8}},
        "per_device_train_batch_size": 2,
        "gradient_accumulation_steps": 2,
        "num_generations": 2,
        "max_steps": 2,
        "save_strategy": "no",
        **CPU_RUN,
        "shuffle_dataset": False,
        **changes,
    }
    tokenizer = tiny_tokenizer()
    return ScaffoldGRPOTrainer(
        tiny_model(tokenizer),
        ScaffoldConfig(**settings),
        train_dataset=Dataset.from_list(task_rows(tasks or toy_tasks())),
        processing_class=tokenizer,
        **({"make_env": make_env} if make_env else {}),
    )
