"""GRPO with a memory that is trained in the loop: the recipe, with a tiny model in the toy world."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("trl")
pytest.importorskip("peft")

from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from recipes.common import CONFIGS
from recipes.grpo_memory import main
from tests.tiny import tiny_model, tiny_tokenizer
from tests.toy_env import TOY
from tests.trainers.builders import CPU_RUN
from trainers.arguments import parse_config
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.counterfactuals import FOLDER
from trainers.presets import as_memory
from trainers.writes import WRITE_CREDITS

SHEET = {"name": "dynamic_cheatsheet", "preset": "rl", "every": 1, "sheet_tokens": 8}
AGENT = {"reasoning": "react", "memory": SHEET, "layout": "snapshot", "sampling": {"max_tokens": 8}}


@pytest.mark.parametrize("credit", WRITE_CREDITS)
def test_three_updates_with_the_cheat_sheet_in_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, credit: str
) -> None:
    tokenizer = tiny_tokenizer()
    tiny_model(tokenizer).save_pretrained(tmp_path / "base")
    tokenizer.save_pretrained(tmp_path / "base")
    folder = tmp_path / "run"
    given = {
        "config": str(CONFIGS / "memory_cpu.yaml"),
        "model": str(tmp_path / "base"),
        "adapter": "",
        "output_dir": str(folder),
        "agent": json.dumps(AGENT),
        "environment": json.dumps({"name": TOY, "options": {"steps": 3, "menu": True}}),
        "write_credit": credit,
        "mask_truncated": "reasoning.react/think",  # of no call here: a random model never ends a sheet
        "num_generations": "2",
        "gradient_accumulation_steps": "2",
        "max_steps": "3",
        "lora_layers": "1",
        "plots": "false",
    }
    options = [word for name, value in given.items() for word in (f"--{name}", value)]
    monkeypatch.setattr(sys, "argv", ["grpo_memory.py", *options])
    main()
    findings = list(audit(folder))
    assert [f.violations for f in findings] == [[], [], []]
    assert all(f.by_tag["memory.dynamic_cheatsheet/curate"] > 0 for f in findings)
    assert all(f.by_tag["reasoning.react/act"] > 0 for f in findings)
    logged = RunLog(folder).read("metrics.jsonl")
    # Four episodes: as many twins, or two re-rolls with and two without one write of each.
    expected = {"episode": None, "local": 16, "ablation": 4}[credit]
    assert [r.get("writes/counterfactuals") for r in logged] == [expected] * 3
    assert (folder / FOLDER).is_dir() == (credit != "episode")


def config(folder: Path, agent: object, **more: object) -> ScaffoldConfig:
    return ScaffoldConfig(output_dir=str(folder), agent=agent, num_generations=2, **CPU_RUN, **more)  # type: ignore[arg-type]


def test_what_follows_from_training_a_memory_is_filled_in(tmp_path: Path) -> None:
    filled = as_memory(config(tmp_path, AGENT))
    assert filled.train_calls == ["reasoning.*", "memory.*"] and filled.mask_truncated == ["memory.*"]
    assert filled.train_credits == ["executed", "aux"]
    given = {"train_calls": ["memory.*/curate"], "train_credits": ["aux"], "mask_truncated": ["reasoning.*"]}
    assert {name: getattr(as_memory(config(tmp_path, AGENT, **given)), name) for name in given} == given


def test_a_memory_that_asks_nothing_cannot_be_trained(tmp_path: Path) -> None:
    helped = {**AGENT, "roles": {"memory.*": {"backend": "openai", "model": "m", "base_url": "http://localhost:1"}}}
    for agent in ({"memory": "base"}, helped):
        with pytest.raises(SpecError, match="the policy is asked nothing for it"):
            as_memory(config(tmp_path, agent))


def test_the_shipped_configuration_trains_a_memory(tmp_path: Path) -> None:
    given = parse_config(["--output_dir", str(tmp_path)], default=str(CONFIGS / "memory_cpu.yaml"))
    as_memory(given).check()
    assert given.write_credit == "local" and given.spec.label == "react+dynamic_cheatsheet (snapshot)"
