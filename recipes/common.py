"""What the recipes share: reading a config, training, resuming."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ.setdefault("WANDB_MODE", "offline")

CONFIGS = Path(__file__).parent / "configs"


def parse_config(argv: Sequence[str] | None = None, default: str = "quickstart_cpu.yaml") -> Any:
    """The run's configuration from ``--config FILE`` and command-line overrides; without ``--config`` the default.

    Raises:
        SpecError: malformed YAML, an unknown key, or a value of the wrong kind.
    """
    from trl import TrlParser

    from agentspec.actions import suggest
    from agentspec.registry import SpecError
    from agentspec.spec import load_yaml
    from trainers.config import ScaffoldConfig

    class Parser(TrlParser):  # type: ignore[misc]  # TRL's parser has no types
        """Says what is wrong in one line, without two hundred lines of usage."""

        def error(self, message: str) -> NoReturn:
            raise SpecError(f"{path}: {message}; `--help` lists every field")

    args = list(sys.argv[1:] if argv is None else argv)
    if "--config" not in args and not any(a.startswith("--config=") for a in args):
        args = ["--config", str(CONFIGS / default), *args]
    path = next((a.partition("=")[2] for a in args if a.startswith("--config=")), None)
    path = path or next(iter(args[args.index("--config") + 1 :]), None)
    if not path or path.startswith("--"):
        raise SpecError("--config needs the path of a YAML file after it")
    data = load_yaml(Path(path))
    known = ScaffoldConfig.__dataclass_fields__
    for key in data:
        if key not in known:
            raise SpecError(f"{path}: unknown key {key!r}{suggest(str(key), known)}")
    try:
        (config,) = Parser((ScaffoldConfig,)).parse_args_and_config(args=args)
    except ValueError as error:
        raise SpecError(f"{path}: {error}") from error
    return config


def train(
    config: Any, *, callbacks: Sequence[Any] = (), trainer_class: Any = None, load: Callable[[Any], Any] | None = None
) -> Any:
    """Train as ``config`` says; returns the trainer. The final model lies in ``config.output_dir``.

    With ``config.resume`` the run continues from its last complete checkpoint.

    Args:
        config: a :class:`~trainers.config.ScaffoldConfig`.
        callbacks: of the trainer.
        trainer_class: default: :class:`~trainers.grpo.ScaffoldGRPOTrainer`.
        load: config -> model and tokenizer; default: :func:`~trainers.policy.load_policy`.
    """
    from datasets import Dataset

    from trainers.grpo import ScaffoldGRPOTrainer
    from trainers.policy import load_policy
    from trainers.report import TerminalReport
    from trainers.resume import last_complete_checkpoint
    from trainers.rollouts import make_tasks, task_rows

    config.check()
    folder = Path(config.output_dir)
    last = last_complete_checkpoint(folder) if config.resume else None
    model, tokenizer = (load or load_policy)(config)
    name, options = config.world
    tasks = make_tasks(name, options, config.train_tasks)
    held_out = make_tasks(name, options, config.validation_tasks, split="validation") if config.validates else []
    trainer = (trainer_class or ScaffoldGRPOTrainer)(
        model,
        config,
        train_dataset=Dataset.from_list(task_rows(tasks)),
        eval_dataset=Dataset.from_list(task_rows(held_out)) if held_out else None,
        processing_class=tokenizer,
        callbacks=list(callbacks),
    )
    trainer.add_callback(TerminalReport(lambda: trainer.last_episodes))
    if trainer.accelerator.is_main_process:
        for note in config.warnings():
            print(f"note: {note}", file=sys.stderr)
    if last:
        print(f"resuming from {last}", file=sys.stderr)
    trainer.train(resume_from_checkpoint=str(last) if last else None)
    trainer.save_model(str(folder))
    return trainer


def draw_curve(config: Any, trainer: Any) -> None:
    """The reward curve as ``reward_curve.png`` in the run's folder (main process, if the config asks for plots)."""
    if config.plots and trainer.accelerator.is_main_process:
        from eval.plots import reward_curve

        reward_curve(trainer.run_log.read("metrics.jsonl"), trainer.run_log.folder / "reward_curve.png")


def run_config(config: Any) -> dict[str, Any]:
    """The configuration as plain data, secrets left out (TRL's own ``to_dict`` masks tokens)."""
    data: dict[str, Any] = config.to_dict()
    return data


def run_recipe(main: Callable[[], None]) -> None:
    """Run a recipe; an expected error is one line and exit code 2."""
    from agentspec.cli.errors import expected_errors

    with expected_errors():
        main()
        if "torch" in sys.modules:  # not for `--help`
            from trainers.distributed import leave_group

            leave_group()
