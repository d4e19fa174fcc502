"""The shipped configurations parse and are sound; a mistake in one is a line and exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from agentspec.registry import SpecError
from recipes.common import CONFIGS, parse_config, run_recipe, train
from trainers.resume import last_complete_checkpoint

ROOT = Path(__file__).resolve().parents[1]
ON_CPU = ["--use_cpu", "true", "--bf16", "false"]


def parsed(name: str, *overrides: str) -> Any:
    config = parse_config(["--config", str(CONFIGS / name), *overrides])
    config.check()
    return config


def test_every_shipped_config_is_sound(tmp_path: Path) -> None:
    names = sorted(p.name for p in CONFIGS.glob("*.yaml"))
    assert {"quickstart_cpu.yaml", "qwen3_4b_paper.yaml", "supo_cpu.yaml"} <= set(names)
    for name in names:
        config = parsed(name, *ON_CPU, "--output_dir", str(tmp_path))
        assert config.output_dir == str(tmp_path) and config.use_cpu and not config.bf16


def test_the_quick_start(tmp_path: Path) -> None:
    config = parsed("quickstart_cpu.yaml")
    assert config.model == "smollm2-135m" and config.adapter and config.use_cpu
    assert config.rewards == {"earning_delta": 1.0} and config.loss_type in ("dapo", "cispo")
    assert config.warnings() == []
    # Whole groups, of rollouts that are compared with each other.
    assert rollouts_per_update(config) % config.num_generations == 0
    assert parse_config([]).output_dir == config.output_dir  # it is the default


def rollouts_per_update(config: Any) -> int:
    return int(config.per_device_train_batch_size * config.gradient_accumulation_steps)


def test_the_paper_s_setting() -> None:
    config = parsed("qwen3_4b_paper.yaml", *ON_CPU)
    name, options = config.world
    assert config.model == "Qwen/Qwen3-4B" and name == "deliverybench"
    assert options["max_steps"] == 40
    assert config.num_generations == 4 and rollouts_per_update(config) == 32
    assert config.rewards == {"earning_delta": 1.0} and config.estimator == "grpo"
    assert config.use_vllm and config.vllm_mode == "colocate"
    # vLLM does not constrain answers to choices, so the actions are written out.
    assert options["action_mode"] == "native"
    # 40 turns of a full observation fit into the context.
    assert config.vllm_max_model_length >= 32_768


def test_overrides_win_and_structures_can_be_given() -> None:
    config = parsed("quickstart_cpu.yaml", "--max_steps", "7", "--agent", '{"reasoning": "react"}')
    assert config.max_steps == 7 and config.spec.reasoning.name == "react"


# --- mistakes --------------------------------------------------------------------------------------------------------


def written(tmp_path: Path, text: str) -> str:
    path = tmp_path / "config.yaml"
    path.write_text(f"output_dir: {tmp_path / 'run'}\nuse_cpu: true\nbf16: false\nreport_to: none\n{text}")
    return str(path)


MISTAKES = {
    "unknown key": ("learning_rte: 1.0\n", "unknown key 'learning_rte'; did you mean learning_rate"),
    "malformed YAML": ("rewards: {earning_delta: 1.0\n", "malformed YAML"),
    "missing model": ("model: no-such-model-here\n", "no-such-model-here"),
    "train_calls without match": ("agent: {reasoning: direct}\ntrain_calls: ['reflection.*']\n", "match no call"),
    "unknown reward": ("rewards: {earnings: 1.0}\n", "earning_delta"),
    "unknown module": ("agent: {reasoning: raect}\n", "react"),
    "refused loss": ("loss_type: luspo\n", "not offered"),
    "wrong kind of value": ("max_steps: many\n", "invalid int value: 'many'"),
    "missing adapter": ("model: smollm2-135m\nadapter: no-such-adapter\n", "no-such-adapter"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_and_exit_code_2(
    tmp_path: Path, mistake: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text, expected = MISTAKES[mistake]
    path = written(tmp_path, text)
    with pytest.raises(SystemExit) as caught:
        run_recipe(lambda: train(parse_config(["--config", path])))
    assert caught.value.code == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and expected in err and "Traceback" not in err, err


def test_a_missing_config_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run_recipe(lambda: parse_config(["--config", str(tmp_path / "none.yaml")]))
    assert caught.value.code == 2
    assert "none.yaml" in capsys.readouterr().err


def test_a_recipe_says_no_as_a_program(tmp_path: Path) -> None:
    path = written(tmp_path, "learning_rte: 1.0\n")
    command = [sys.executable, "-m", "recipes.grpo_delivery", "--config", path]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("agentspec: error: ") and done.stderr.count("\n") == 1, done.stderr


def test_a_config_without_value_for_config_is_refused() -> None:
    with pytest.raises(SpecError, match="--config"):
        parse_config(["--config"])


# --- which checkpoint a run resumes from -----------------------------------------------------------------------------


def checkpoint(folder: Path, step: int, *files: str) -> Path:
    path = folder / f"checkpoint-{step}"
    path.mkdir(parents=True)
    for name in files:
        (path / name).write_text("{}")
    return path


def test_a_half_written_checkpoint_is_passed_over(tmp_path: Path) -> None:
    assert last_complete_checkpoint(tmp_path / "nothing") is None
    checkpoint(tmp_path, 12, "model.safetensors", "trainer_state.json")  # killed before its last file
    assert last_complete_checkpoint(tmp_path) is None
    whole = checkpoint(tmp_path, 9, "trainer_state.json", "scaffold_state.json")
    checkpoint(tmp_path, 10, "scaffold_state.json")  # killed while it was deleted
    checkpoint(tmp_path, 8, "trainer_state.json", "scaffold_state.json")
    (tmp_path / "checkpoint-best").mkdir()
    # By number, not by name: 9 < 10 < 12.
    assert last_complete_checkpoint(tmp_path) == whole
