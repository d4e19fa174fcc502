"""From a configuration to a trained run: what is checked first, what is said when it is stopped."""

from __future__ import annotations

import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("trl")

from agentspec.registry import SpecError
from recipes.common import run_recipe
from tests.toy_env import TOY
from trainers.config import ScaffoldConfig
from trainers.run import train


def config(folder: Path, **changes: Any) -> ScaffoldConfig:
    settings = {"use_cpu": True, "bf16": False, "report_to": [], "environment": TOY, "train_tasks": 2}
    return ScaffoldConfig(output_dir=str(folder), **{**settings, **changes})


class Stopped:
    """A trainer whose user presses Ctrl-C."""

    last_episodes: tuple[Any, ...] = ()

    def __init__(self, model: Any, args: Any, **_: Any) -> None:
        self.accelerator = SimpleNamespace(is_main_process=True)
        self.callbacks: list[Any] = []
        self.add_callback = self.callbacks.append

    def pop_callback(self, callback: Any) -> None:
        return None

    def remove_callback(self, callback: Any) -> None:
        return None

    def train(self, **_: Any) -> None:
        raise KeyboardInterrupt


def test_a_stopped_run_says_how_to_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def stop() -> None:
        train(config(tmp_path), trainer_class=Stopped, load=lambda config: (None, None))  # type: ignore[arg-type]

    with pytest.raises(SystemExit) as caught:
        run_recipe(stop)
    assert caught.value.code == 130
    assert "stopped before the first checkpoint; the same command starts anew" in capsys.readouterr().err
    checkpoint = tmp_path / "checkpoint-3"
    checkpoint.mkdir()
    for name in ("trainer_state.json", "scaffold_state.json"):
        (checkpoint / name).write_text("{}")
    with pytest.raises(SystemExit):
        run_recipe(stop)
    assert f"the same command with `--resume` continues from {checkpoint}" in capsys.readouterr().err


def test_nothing_is_loaded_for_a_configuration_that_cannot_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(config: Any) -> Any:
        raise AssertionError("the model was loaded")

    monkeypatch.setattr("trainers.checks.importlib.util.find_spec", lambda name: None)
    with pytest.raises(SpecError, match="tensorboard, which is not installed"):
        train(config(tmp_path, report_to=["tensorboard"]), load=load)


@pytest.mark.parametrize("setting", [{}, {"gradient_checkpointing": False}, {"gradient_checkpointing": True}])
def test_a_configuration_warns_of_no_library_s_future(tmp_path: Path, setting: dict[str, bool]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        made = config(tmp_path, **setting)
    assert made.gradient_checkpointing is setting.get("gradient_checkpointing", True)  # TRL's default


def test_the_user_s_choice_for_wandb_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib
    import os

    import recipes.common

    for value in (None, "online"):
        monkeypatch.delenv("WANDB_MODE", raising=False)
        if value:
            monkeypatch.setenv("WANDB_MODE", value)
        importlib.reload(recipes.common)
        assert os.environ.get("WANDB_MODE") == value
