"""What the recipes share: where their configurations lie, how a script ends, the reward curve."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agentspec.cli.ours import claim_packages

os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

claim_packages()

CONFIGS = Path(__file__).parent / "configs"


def train_and_draw(config: Any, **how: Any) -> Any:
    """Train (`trainers.run.train`), and draw the reward curve into the run's folder if the config asks for plots.

    Torch and TRL are imported only here: what is wrong with a configuration has been told by then. The trainer is given
    back when all processes are through.
    """
    from trainers.run import train

    trainer = train(config, **how)
    trainer.accelerator.wait_for_everyone()
    if config.plots and trainer.accelerator.is_main_process:
        from agentspec.records.folder import METRICS
        from eval.plots import reward_curve

        reward_curve(trainer.run_log.read(METRICS), trainer.run_log.folder / "reward_curve.png", unit=unit(config))
    return trainer


def unit(config: Any) -> str:
    """What a reward is, as a formula: `1 x earning_delta`."""
    return " + ".join(f"{weight:g} x {name}" for name, weight in config.reward_set.weights.items())


def run_recipe(main: Callable[[], None]) -> None:
    """Run a recipe; an expected error is one line and exit code 2, Ctrl-C exit code 130. Launched, it ends here."""
    from agentspec.cli.errors import expected_errors

    with expected_errors():
        try:
            main()
        except KeyboardInterrupt:
            raise SystemExit(130) from None
        if "torch" in sys.modules:  # not for `--help`
            from trainers.distributed import end_process

            end_process()
