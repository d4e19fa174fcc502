"""The Retroformer recipe from nothing to its table, with a tiny model in the toy world."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("trl")
pytest.importorskip("peft")

from safetensors.torch import load_file

from eval.lessons import markdown
from recipes.common import CONFIGS
from recipes.retroformer_delivery import CONTROL, main
from tests.tiny import tiny_model, tiny_tokenizer
from tests.toy_env import TOY
from trainers.arguments import parse_config
from trainers.audit import audit
from trainers.retroformer import as_retroformer

ON_CPU = ["--use_cpu", "true", "--bf16", "false"]


def test_from_nothing_to_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tokenizer = tiny_tokenizer()
    tiny_model(tokenizer).save_pretrained(tmp_path / "base")
    tokenizer.save_pretrained(tmp_path / "base")
    folder = tmp_path / "run"
    agent = {"reasoning": "direct", "reflection": {"name": "retroformer", "threshold": 99.0, "reflection_tokens": 6}}
    given = {
        "config": str(CONFIGS / "retroformer_cpu.yaml"),
        "model": str(tmp_path / "base"),
        "actor_adapter": "",
        "actor_temperature": "1.0",
        "output_dir": str(folder),
        "agent": json.dumps(agent),
        "environment": json.dumps({"name": TOY, "options": {"steps": 3, "menu": True}}),
        "num_generations": "2",
        "gradient_accumulation_steps": "2",
        "max_steps": "2",
        "lora_layers": "1",
        "eval_tasks": "3",
        "plots": "false",
    }
    options = [word for name, value in given.items() for word in (f"--{name}", value)]
    monkeypatch.setattr(sys, "argv", ["retroformer_delivery.py", *options])
    main()
    # What was trained, and what was not.
    start = load_file(folder / "checkpoint-1" / "actor" / "adapter_model.safetensors")
    actor = load_file(folder / "actor" / "adapter_model.safetensors")
    assert all(torch.equal(start[n], w) for n, w in actor.items())
    reflector = load_file(folder / "adapter_model.safetensors")
    assert any(w.any() for n, w in reflector.items() if "lora_B" in n)  # these start at zero
    assert not any(w.any() for n, w in actor.items() if "lora_B" in n)
    assert [v for r in audit(folder) for v in r.violations] == []
    # The evaluation: the same tasks and the same first trials for both reflectors and for the meaningless lesson.
    rows = [json.loads(line) for line in (folder / "evaluation.jsonl").read_text().splitlines()]
    control, before, after = rows[:3], rows[3:6], rows[6:]
    assert [r["seed"] for r in control] == [r["seed"] for r in before] == [r["seed"] for r in after]
    assert [r["seed"] for r in before] == [20_000, 20_001, 20_002]
    assert [r["first_return"] for r in control] == [r["first_return"] for r in before]
    assert [r["first_return"] for r in before] == [r["first_return"] for r in after]
    # A threshold of 99 fails every trial: each is played again with the same words.
    assert [r["lesson"] for r in control] == [CONTROL] * 3 and all(r["lesson"] != CONTROL for r in rows[3:])
    table = (folder / "evaluation.md").read_text()
    assert table == markdown(rows) and table in capsys.readouterr().out
    for a, b in (("before", "meaningless lesson"), ("after", "meaningless lesson"), ("after", "before training")):
        assert f"Paired difference in gain, {a} training less {b}: " in table


def row(reflector: str, task: str, first: float | None, second: float | None, lesson: str = "x") -> dict:
    return {"reflector": reflector, "task": task, "first_return": first, "second_return": second, "lesson": lesson}


def test_the_table_is_derived_by_hand() -> None:
    rows = [
        *(row("before", "a", 1.0, 2.0), row("before", "b", 5.0, 5.0, ""), row("before", "c", None, None, "")),
        *(row("after", "a", 1.0, 6.0), row("after", "b", 5.0, 5.0, ""), row("after", "c", 1.0, 9.0)),
    ]
    lines = markdown(rows).splitlines()
    cells = {line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]] for line in lines if "|" in line}
    # Gains 1 and 0, mean 0.5; the task that failed to run is left out.
    assert cells["before"][:2] == ["2", "1"] and [c.split()[0] for c in cells["before"][2:]] == ["3.00", "3.50", "0.50"]
    # Gains 5, 0 and 8, mean 4.33; in the paired difference a and b only: (5 - 1 + 0 - 0) / 2.
    assert cells["after"][:2] == ["3", "2"] and cells["after"][4].startswith("4.33")
    assert lines[-1].startswith("Paired difference in gain, after less before: 2.00")


def test_the_shipped_configuration_trains_a_reflector(tmp_path: Path) -> None:
    path = str(CONFIGS / "retroformer_cpu.yaml")
    config = as_retroformer(parse_config(["--output_dir", str(tmp_path), *ON_CPU], default=path))
    config.check()
    assert config.train_calls == ["reflection.retroformer/reflect"] and config.spec.scope == "run"
    assert config.actor_adapter == "smollm2-135m-courier" and config.actor_temperature == 0.0
