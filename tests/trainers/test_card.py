"""The cards of runs and exports are ours, and name no path of this machine."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

pytest.importorskip("trl")
pytest.importorskip("peft")

from agentspec.spec import AgentSpec
from tests.trainers.played import toy_tasks, toy_trainer
from trainers.card import base_name, model_card
from trainers.export import export


def head(text: str) -> dict:
    return yaml.safe_load(text.split("---")[1])


def test_a_card_names_its_base_as_the_configuration_does() -> None:
    spec = {"reasoning": "react", "sampling": {"max_tokens": 9}}
    config = {"model": "smollm2-135m", "rewards": {"success": 1.0}, "estimator": "grpo", "loss_type": "dapo"}
    text = model_card("mine", config, spec, adapter=True, note="update 4")
    assert head(text)["base_model"] == "HuggingFaceTB/SmolLM2-135M-Instruct" and head(text)["library_name"] == "peft"
    assert "# mine" in text and "| base model | smollm2-135m |" in text and "| weights | update 4 |" in text
    assert "| rewards | {success: 1.0} |" in text and "| estimator and loss | grpo, dapo |" in text
    block = text.split("```yaml\n")[1].split("```")[0]
    assert AgentSpec.from_yaml(block) == AgentSpec.from_data(spec)
    assert "agentspec run --policy smollm2-135m --adapter FOLDER --spec agent.yaml" in text


def test_a_folder_is_named_by_its_last_part(tmp_path: Path) -> None:
    (tmp_path / "my-model").mkdir()
    assert base_name(str(tmp_path / "my-model")) == "my-model"
    assert base_name("/gone/my-model") == base_name("./my-model") == "my-model"
    assert base_name("Qwen/Qwen3-4B") == "Qwen/Qwen3-4B"
    text = model_card("x", {"model": str(tmp_path / "my-model")}, None, adapter=False)
    assert "base_model" not in head(text) and str(tmp_path) not in text and "| base model | my-model |" in text


def test_runs_checkpoints_and_exports_have_it(tmp_path: Path) -> None:
    run = tmp_path / "run"
    trainer = toy_trainer(run, toy_tasks(2), max_steps=1, save_strategy="steps", save_steps=1)
    trainer.train()
    trainer.save_model(str(run))
    export(run, tmp_path / "out")
    for folder in (run, run / "checkpoint-1", tmp_path / "out"):
        text = (folder / "README.md").read_text(encoding="utf-8")
        assert head(text)["tags"] == ["agentspec"] and "trained inside an agent's scaffold" in text
        assert str(tmp_path) not in text and "Framework versions" not in text
    assert "README.md" in json.loads((tmp_path / "out" / "agentspec.json").read_text())["files"]
