"""Every world: a warm start from its expert, and two updates of its shipped configuration, with a tiny model."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("trl")
pytest.importorskip("peft")

from agentspec.records.log import RunLog
from recipes import grpo_delivery, sft_warmup
from recipes.common import CONFIGS
from tests.tiny import tiny_model, tiny_tokenizer
from trainers.audit import audit

WARMUPS = {
    "deliverybench": {
        "size": "tiny",
        "shift_hours": 0.1,
        "observation": "compact",
        "action_mode": "menu",
        "max_steps": 3,
    },
    "minigrid": {"suite": "memory", "observation": "compact", "action_mode": "menu"},
    "alfred": {"action_mode": "menu"},
    "robothor": {"action_mode": "menu"},
}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("base")
    tokenizer = tiny_tokenizer()
    small = {"num_hidden_layers": 1, "hidden_size": 32, "intermediate_size": 32, "max_position_embeddings": 16_384}
    tiny_model(tokenizer, **small).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    return folder


def run(main, monkeypatch: pytest.MonkeyPatch, **given: str) -> None:
    words = [word for name, value in given.items() for word in (f"--{name}", value)]
    monkeypatch.setattr(sys, "argv", ["recipe.py", *words])
    main()


@pytest.mark.parametrize("world", WARMUPS)
def test_a_warm_start_from_the_expert(base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, world: str) -> None:
    if world == "minigrid":
        pytest.importorskip("minigrid")
    run(
        sft_warmup.main,
        monkeypatch,
        config=str(CONFIGS / "warmup_cpu.yaml"),
        model=str(base),
        environment=json.dumps({"name": world, "options": WARMUPS[world]}),
        output_dir=str(tmp_path / "warm"),
        train_tasks="2",
        max_steps="2",
        warmup_steps="0",
        learning_rate="0.05",
        lora_layers="0",
        logging_steps="1",
    )
    saved = json.loads((tmp_path / "warm" / "manifest.json").read_text())
    assert saved["demonstrations"] == 2
    from safetensors.torch import load_file

    adapter = load_file(tmp_path / "warm" / "adapter_model.safetensors")
    # LoRA's second factor begins at 0: it holds something because tokens of the expert were trained.
    assert all(value.abs().max() > 0 for name, value in adapter.items() if "lora_B" in name)


@pytest.mark.parametrize("name", ["minigrid_cpu.yaml", "alfred_cpu.yaml"])
def test_two_updates_of_a_world_s_configuration(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    if name.startswith("minigrid"):
        pytest.importorskip("minigrid")
    folder = tmp_path / "run"
    config = shorter(name)
    run(
        grpo_delivery.main,
        monkeypatch,
        config=str(CONFIGS / name),
        model=str(base),
        adapter="",
        environment=json.dumps(config),
        output_dir=str(folder),
        num_generations="2",
        per_device_train_batch_size="1",
        gradient_accumulation_steps="4",
        max_steps="2",
        eval_tasks="1",
        lora_layers="0",
        plots="false",
    )
    assert [f.violations for f in audit(folder)] == [[], []]
    logged = RunLog(folder).read("metrics.jsonl")
    assert len(logged) == 2 and all(row["rewards/" + reward + "/mean"] >= 0 for row in logged for reward in PAID[name])


PAID = {"minigrid_cpu.yaml": ("success", "efficiency"), "alfred_cpu.yaml": ("goal_progress",)}


def shorter(name: str) -> dict[str, object]:
    """The world of a configuration, with fewer steps."""
    from trainers.arguments import read_config

    world = dict(read_config(CONFIGS / name)["environment"])
    return world | {"options": world["options"] | {"max_steps": 6}}
