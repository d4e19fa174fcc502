"""The study end to end with a tiny random model: trained, stopped, resumed, evaluated, audited, reported."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("trl")
pytest.importorskip("peft")
pytest.importorskip("minigrid")

from agentspec.extends import read_extended
from agentspec.files import read_lines
from agentspec.registry import SpecError
from recipes import grpo_delivery, grpo_memory, learning_study, sft_warmup, supo_delivery
from recipes.common import CONFIGS
from tests.tiny import tiny_model, tiny_tokenizer

RECIPES = {"grpo_delivery": grpo_delivery, "grpo_memory": grpo_memory, "supo_delivery": supo_delivery}
SHEET = {"name": "dynamic_cheatsheet", "preset": "rl", "every": 2, "sheet_tokens": 8, "step_tokens": 8}
SMALL = {"sampling": {"max_tokens": 8}, "layout": "snapshot"}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("base")
    tokenizer = tiny_tokenizer()
    small = {"num_hidden_layers": 1, "hidden_size": 32, "intermediate_size": 32, "max_position_embeddings": 16_384}
    tiny_model(tokenizer, **small).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    return folder


def study(base: Path, out: Path, **changes: Any) -> dict[str, Any]:
    world = {"name": "minigrid", "options": {"level": "MiniGrid-MemoryS7-v0", "observation": "compact"}}
    world["options"] |= {"action_mode": "menu", "max_steps": 3}
    train = {"extends": "minigrid_cpu", "model": str(base), "adapter": "", "environment": world, "max_steps": 1}
    train["environment"]["options"]["suite"] = None
    train |= {"num_generations": 2, "per_device_train_batch_size": 1, "gradient_accumulation_steps": 2}
    train |= {"lora_layers": 0, "plots": False, "train_tasks": 4, "rewards": {"success": 1.0, "efficiency": None}}
    return {
        "out": str(out),
        "seeds": [0],
        "tasks": 2,
        "scaffolds": {"none": SMALL, "sheet": {**SMALL, "memory": SHEET}},
        "train": train,
        # A random model never ends its sheet, and what is cut off would not be trained.
        "arms": {
            "none": {"scaffold": "none"},
            "sheet": {"scaffold": "sheet", "trainer": "memory", "mask_truncated": ["reasoning.*"]},
        },
        "references": ["random"],
        "rates": {"read": 100, "write": 10, "update": 50},
        **changes,
    }


def written(folder: Path, data: dict[str, Any]) -> str:
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(data))
    return str(path)


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["learning_study", *words])
    learning_study.main()


def test_two_scaffolds_and_one_update_end_to_end(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every run a process of its own, as for real."""
    out = tmp_path / "out"
    asked = {"table": {"Non-RL": "start", "GRPO": "none"}, "compare": {"notes": ["none", "sheet"]}, "rates": {}}
    config = written(tmp_path, study(base, out, **asked))
    run(monkeypatch, "--config", config, "--dry-run")
    said = capsys.readouterr().out
    assert "2 training runs" in said and "3 policies x 2 scaffolds x 2 episodes = 12 episodes" in said
    assert "rates (measured just now, from two prompts): read" in said
    assert not (out / "runs").exists() and not (out / "results.jsonl").exists()
    run(monkeypatch, "--config", config, "--jobs", "2")
    text = (out / "report" / "report.md").read_text()
    for heading in ("The paper's table", "Is a policy best where it was trained?", "What training gained"):
        assert heading in text
    for heading in ("Compared in pairs", "What was trained", "What it took", "Audit receipts"):
        assert heading in text
    assert "this checkpoint only" in text and "memory.dynamic_cheatsheet/curate" in text
    told = json.loads((out / "study.json").read_text())
    assert {name: found["violations"] for name, found in told["audits"].items()} == {"none-s0": [], "sheet-s0": []}
    assert all(found["updates"] == 1 for found in told["audits"].values())
    rows, kept = read_lines(out / "results.jsonl"), {line["key"] for line in read_lines(out / "episodes.jsonl")}
    # start, two runs and a scripted policy, in two scaffolds, on two tasks; every number has its episode in the store.
    # (The scripted one writes no sheet: its episodes in both are the same, and kept once.)
    assert len(rows) == 16 and {row["key"] for row in rows} == kept and len(kept) == 14
    spent = [line["what"] for line in read_lines(out / "costs.jsonl")]
    assert sorted(spent) == ["evaluation", "train none", "train sheet"]
    # Again: nothing is left to train or to play.
    monkeypatch.setattr(learning_study, "process", None)
    run(monkeypatch, "--config", config)
    assert len(read_lines(out / "episodes.jsonl")) == 14


def here(study: Any, what: str, recipe: str, config: str, folder: Path, *more: str) -> None:
    """In the place of `learning_study.process`: the recipe in this process."""
    file = Path(study.out) / "configs" / f"{config}.yaml"
    main = sft_warmup.main if recipe == "sft_warmup" else RECIPES[recipe].main
    sys.argv = [recipe, "--config", str(file), "--output_dir", str(folder), *more]
    main()


def test_a_study_killed_after_one_arm_goes_on_where_it_stopped(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a warm start that is a mixture, which both arms begin with."""
    out = tmp_path / "out"
    warm = {"extends": "warmup_minigrid", "model": str(base), "environment": study(base, out)["train"]["environment"]}
    warm |= {"agent": {"sampling": {"max_tokens": 512}}, "scaffolds": [{"memory": ["none", SHEET]}], "train_tasks": 4}
    warm |= {"train_calls": ["reasoning.*", "memory.*"], "train_credits": ["executed", "aux"], "lora_layers": 0}
    warm |= {"warmup_steps": 0, "per_device_train_batch_size": 2, "max_steps": 2}
    config = written(tmp_path, study(base, out, warmup=warm))
    done: list[str] = []

    def dies(study: Any, what: str, *given: Any) -> None:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(what)
        here(study, what, *given)

    monkeypatch.setattr(learning_study, "process", dies)
    with pytest.raises(KeyboardInterrupt):
        run(monkeypatch, "--config", config)
    assert done == ["warm start", "train none"] and not (out / "results.jsonl").exists()
    head = (out / "runs" / "none-s0" / "seal.json").read_bytes()
    again: list[str] = []

    def notes(study: Any, what: str, *given: Any) -> None:
        again.append(what)
        here(study, what, *given)

    monkeypatch.setattr(learning_study, "process", notes)
    run(monkeypatch, "--config", config)
    assert again == ["train sheet"] and (out / "runs" / "none-s0" / "seal.json").read_bytes() == head
    manifest = json.loads((out / "runs" / "sheet-s0" / "manifest.json").read_text())
    assert manifest["config"]["adapter"] == str(out / "warmup")
    assert {row["policy"] for row in read_lines(out / "results.jsonl")} == {"start", "none", "sheet", "random"}
    # A changed arm under the same name would mix two recipes in one row of the table.
    changed = study(base, out, warmup=warm)
    changed["arms"]["none"]["learning_rate"] = 0.5
    with pytest.raises(SpecError, match="'none' has runs of another configuration"):
        run(monkeypatch, "--config", written(tmp_path, changed))


def test_a_missing_study_is_told_with_those_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SpecError, match=r"give --config FILE.*transfer_cpu, .*transfer_minigrid_cpu"):
        run(monkeypatch)


@pytest.mark.parametrize("name", ["transfer_cpu", "transfer_groups_cpu", "transfer_minigrid_cpu", "transfer_qwen3_4b"])
def test_the_shipped_studies_are_sound(tmp_path: Path, name: str) -> None:
    from eval.study import read_study
    from eval.study.cost import Rates

    data = read_extended(name, CONFIGS)
    on_cpu = {"use_cpu": True, "bf16": False, "report_to": "none", "use_vllm": False}
    if name == "transfer_qwen3_4b":
        for key in [k for k in read_extended("qwen3_4b_paper", CONFIGS) if k.startswith("vllm")]:
            on_cpu[key] = None
        data["train"] |= on_cpu
    given = read_study({**data, "out": str(tmp_path)})
    assert len(given.seeds) >= 3 and given.tasks >= 32 and Rates.from_data(given.rates)
    for arm in given.arms:
        config = learning_study.arm_config(given, arm)
        assert config.spec.label == given.scaffolds[given.arms[arm].scaffold].label
    if given.warmup:
        warm = learning_study.written(given, "warmup", given.warmup, False)
        labels = {spec.label for spec in warm.mixture}
        # The start has met every scaffold that somebody is trained in, and none that is held out.
        assert {given.scaffolds[arm.scaffold].label for arm in given.arms.values()} <= labels
        assert not any("mad" in label or "openclaw" in label for label in labels)


def test_held_out_are_episodes_that_nobody_is_trained_on(tmp_path: Path) -> None:
    """The study of MiniGrid, whose seeds repeat 196 layouts; and a start that another study has left."""
    from agentspec.tasks import SPLITS, episode_key, make_tasks
    from eval.study import read_study
    from eval.study.playing import held_out

    given = read_study({**read_extended("transfer_minigrid_cpu", CONFIGS), "out": str(tmp_path)})
    configs = {arm: learning_study.arm_config(given, arm) for arm in given.arms}
    warm = learning_study.written(given, "warmup", given.warmup, False)
    [held] = held_out(given.tasks, [*configs.values(), warm]).values()
    trained = {episode_key(task) for c in (warm, *configs.values()) for task in make_tasks(*c.world, c.train_tasks)}
    played = {episode_key(task) for task in held}
    assert len(played) == len(held) == given.tasks == 32 and not played & trained
    assert all(task.split == "test" and task.seed >= SPLITS["test"] for task in held)
    by_seed = make_tasks(*warm.world, 32, split="test")  # seeds alone do not keep them apart
    assert any(episode_key(task) in trained for task in by_seed)
    # The same start as a folder, from which its manifest tells what it was trained on.
    told = {"environment": {"name": warm.world[0], "options": warm.world[1]}, "train_tasks": 192, "adapter": ""}
    (tmp_path / "manifest.json").write_text(json.dumps({"config": told}))
    for config in configs.values():
        config.adapter = str(tmp_path)
    assert held_out(32, [*configs.values()]) == {"minigrid": held}
    warm.train_tasks = 5000
    with pytest.raises(SpecError, match=r"got 32 tasks, expected at most 0: minigrid with .*MemoryS13Random"):
        held_out(32, [*configs.values(), warm])


def test_the_paper_s_six_are_evaluated() -> None:
    from eval.study import read_study

    scaffolds = read_study(read_extended("transfer_cpu", CONFIGS)).scaffolds.values()
    agents = {(spec.reasoning.name, spec.memory.name) for spec in scaffolds}
    sheets = {("react", memory) for memory in ("dynamic_cheatsheet", "memorybank", "openclaw", "base")}
    assert sheets | {("direct", "base"), ("mad", "base")} <= agents
