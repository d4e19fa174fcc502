"""A configuration becomes a trained run: load, train, save; resume what was interrupted."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from datasets import Dataset
from transformers import PrinterCallback, ProgressCallback

from agentspec.records.folder import hold, last_complete_checkpoint
from agentspec.tasks import make_tasks
from trainers.checks import notes
from trainers.config import ScaffoldConfig
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.policy import load_policy
from trainers.report import Bar, TerminalReport
from trainers.rollouts import task_rows


def train(
    config: ScaffoldConfig,
    *,
    callbacks: Sequence[Any] = (),
    trainer_class: type[ScaffoldGRPOTrainer] = ScaffoldGRPOTrainer,
    load: Callable[[ScaffoldConfig], Any] = load_policy,
) -> Any:
    """Train as `config` says. The final model lies in `config.output_dir`.

    With `config.resume` the run continues from its last complete checkpoint.

    Args:
        config: checked before anything is loaded.
        callbacks: of the trainer, beside the report in the terminal.
        trainer_class: `trainers.retroformer.RetroformerTrainer`, say.
        load: configuration -> model and tokenizer.

    Returns:
        the trainer.

    Raises:
        SpecError: the configuration cannot work, or another run is writing into its folder.
        KeyboardInterrupt: after a line that says how to go on.
    """
    config.check()
    folder = Path(config.output_dir)
    last = last_complete_checkpoint(folder) if config.resume else None
    model, tokenizer = load(config)
    trainer = _trainer(trainer_class, config, model, tokenizer, callbacks)
    main = trainer.accelerator.is_main_process
    for line in (*(f"note: {n}" for n in notes(config)), *([f"resuming from {last}"] if last else [])) if main else ():
        print(line, file=sys.stderr)
    with hold(folder) if main else nullcontext():  # until the final model is saved
        try:
            trainer.train(resume_from_checkpoint=str(last) if last else None)
        except KeyboardInterrupt:
            if main:
                print(f"\n{_how_to_continue(folder)}", file=sys.stderr)
            raise
        trainer.save_model(str(folder))
    return trainer


def _trainer(
    kind: type[ScaffoldGRPOTrainer], config: ScaffoldConfig, model: Any, tokenizer: Any, callbacks: Sequence[Any]
) -> ScaffoldGRPOTrainer:
    """The trainer, with its tasks and with our reports in the place of the libraries'."""
    name, options = config.world
    tasks = make_tasks(name, options, config.train_tasks)
    held_out = make_tasks(name, options, config.validation_tasks, split="validation") if config.validates else []
    trainer = kind(
        model,
        config,
        train_dataset=Dataset.from_list(task_rows(tasks)),
        eval_dataset=Dataset.from_list(task_rows(held_out)) if held_out else None,
        processing_class=tokenizer,
        callbacks=list(callbacks),
    )
    if trainer.pop_callback(ProgressCallback):
        trainer.add_callback(Bar)
    trainer.remove_callback(PrinterCallback)
    trainer.add_callback(TerminalReport(lambda: trainer.last_episodes))
    return trainer


def _how_to_continue(folder: Path) -> str:
    last = last_complete_checkpoint(folder)
    if last is None:
        return "stopped before the first checkpoint; the same command starts anew (`save_steps` says when one is made)"
    return f"stopped; the same command with `--resume` continues from {last}"
