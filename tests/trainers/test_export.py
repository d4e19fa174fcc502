"""An export acts as the live model does, and is whole or absent."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("peft")

from peft import LoraConfig, PeftModel, get_peft_model
from transformers import AutoModelForCausalLM, AutoTokenizer

from agentspec.files import file_digest
from agentspec.llm.models import ModelNotFoundError
from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from tests.tiny import tiny_model, tiny_tokenizer
from trainers.export import MANIFEST, export, find_trained, reward_summary

TEXT = "go to pickup of order 3"


def logprobs(model: Any) -> torch.Tensor:
    """Log-probabilities of the tokens of TEXT, after the first."""
    ids = torch.tensor([tiny_tokenizer()(TEXT)["input_ids"]])
    with torch.no_grad():
        logits = model.eval()(ids).logits[:, :-1].float()
    return logits.log_softmax(-1).gather(-1, ids[:, 1:, None]).squeeze(-1)


@pytest.fixture
def base(tmp_path: Path) -> Path:
    tokenizer = tiny_tokenizer()
    tiny_model(tokenizer).save_pretrained(tmp_path / "base")
    tokenizer.save_pretrained(tmp_path / "base")
    return tmp_path / "base"


def trained_model(base: Path) -> Any:
    """The base with a LoRA adapter whose weights are no longer those it starts with (where B is 0)."""
    model = get_peft_model(AutoModelForCausalLM.from_pretrained(base), LoraConfig(r=4, target_modules="all-linear"))
    torch.manual_seed(1)
    for name, parameter in model.named_parameters():
        if "lora_" in name:
            parameter.data.normal_(std=0.2)
    return model


def write_run(run: Path, model: Any, base: Path, *, folder: str = "") -> None:
    target = run / folder
    model.save_pretrained(target)
    tiny_tokenizer().save_pretrained(target)
    (target / "optimizer.pt").write_bytes(b"never copied, never unpickled")
    RunLog(run).manifest(config={"model": str(base), "environment": {"name": "toy"}}, spec={"reasoning": "direct"})
    for step, reward in enumerate([1.0, 2.0, 6.0, 3.0], 1):
        RunLog(run).append("metrics.jsonl", {"step": step, "reward": reward})
    RunLog(run).append("metrics.jsonl", {"step": 4, "train_runtime": 1.0})


def test_live_exported_and_merged_models_agree(tmp_path: Path, base: Path) -> None:
    live = trained_model(base)
    write_run(tmp_path / "run", live, base)
    adapter = export(tmp_path / "run", tmp_path / "adapter")
    merged = export(tmp_path / "run", tmp_path / "merged", merge=True)
    expected = logprobs(live)
    untrained = logprobs(AutoModelForCausalLM.from_pretrained(base))
    assert (expected - untrained).abs().max() > 0.1  # the adapter matters
    on_base = PeftModel.from_pretrained(AutoModelForCausalLM.from_pretrained(base), adapter)
    torch.testing.assert_close(logprobs(on_base), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(logprobs(AutoModelForCausalLM.from_pretrained(merged)), expected, atol=1e-5, rtol=0)
    for folder in (adapter, merged):
        tokenizer = AutoTokenizer.from_pretrained(folder)
        assert tokenizer.chat_template == tiny_tokenizer().chat_template
        assert tokenizer(TEXT)["input_ids"] == tiny_tokenizer()(TEXT)["input_ids"]
        assert all(p.stat().st_mode & 0o777 == 0o644 for p in folder.iterdir())
        assert not [p for p in folder.iterdir() if p.suffix in (".pt", ".bin", ".pkl")]


def test_the_manifest_says_what_it_is(tmp_path: Path, base: Path) -> None:
    write_run(tmp_path / "run", trained_model(base), base)
    manifest = json.loads((export(tmp_path / "run", tmp_path / "out") / MANIFEST).read_text())
    assert manifest["kind"] == "adapter" and manifest["source"] == "final model"
    assert manifest["base_model"] == {"name": str(base), "path": str(base), "revision": ""}
    assert manifest["scaffold"] == {"reasoning": "direct"} and manifest["environment"] == {"name": "toy"}
    assert len(manifest["template_sha256"]) == len(manifest["tokenizer_sha256"]) == 64
    # four logged rewards, fewer than the window of 5: first = last = (1 + 2 + 6 + 3) / 4
    assert manifest["rewards"] == {"steps": 4, "first": 3.0, "last": 3.0, "best": 6.0, "best_step": 3}
    assert {"adapter_model.safetensors", "tokenizer.json"} <= set(manifest["files"])
    assert manifest["versions"]["export"]["peft"]
    written = {p.name: file_digest(p) for p in (tmp_path / "out").iterdir() if p.name != MANIFEST}
    assert manifest["files"] == written


def test_the_last_complete_checkpoint_stands_in_for_the_final_model(tmp_path: Path, base: Path) -> None:
    model, run = trained_model(base), tmp_path / "run"
    for step in (2, 10, 12):
        write_run(run, model, base, folder=f"checkpoint-{step}")
        if step != 12:  # the trainer's state is written last: this one was cut short
            for name in ("trainer_state.json", "scaffold_state.json"):
                (run / f"checkpoint-{step}" / name).write_text("{}")
    assert find_trained(run).folder.name == "checkpoint-10"  # not "checkpoint-2", which sorts last as text
    manifest = json.loads((export(run, tmp_path / "out") / MANIFEST).read_text())
    assert manifest["source"] == "checkpoint-10"
    assert manifest["scaffold"] == {"reasoning": "direct"}  # the run's manifest counts, not the checkpoint's


def test_a_run_that_trained_all_weights_is_a_model(tmp_path: Path, base: Path) -> None:
    model = tiny_model(tiny_tokenizer(), seed=3)
    write_run(tmp_path / "run", model, base)
    for merge in (False, True):
        folder = export(tmp_path / "run", tmp_path / f"out-{merge}", merge)
        torch.testing.assert_close(logprobs(AutoModelForCausalLM.from_pretrained(folder)), logprobs(model))
        manifest = json.loads((folder / MANIFEST).read_text())
        assert manifest["kind"] == "model" and manifest["base_model"]["name"] == str(base)


def test_a_merged_half_precision_model_keeps_its_type(tmp_path: Path, base: Path) -> None:
    model = AutoModelForCausalLM.from_pretrained(base, dtype=torch.bfloat16)
    model.save_pretrained(base)
    write_run(tmp_path / "run", trained_model(base), base)
    merged = AutoModelForCausalLM.from_pretrained(export(tmp_path / "run", tmp_path / "out", merge=True))
    assert merged.dtype == torch.bfloat16


def test_refusals(tmp_path: Path, base: Path) -> None:
    with pytest.raises(SpecError, match="no run folder"):
        export(tmp_path / "nowhere", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SpecError, match=r"no trained weights.*save_steps"):
        export(tmp_path / "empty", tmp_path / "out")
    write_run(tmp_path / "run", trained_model(base), base)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(SpecError, match="not an empty folder"):
        export(tmp_path / "run", tmp_path / "full")
    (tmp_path / "empty").rmdir()
    (tmp_path / "empty").mkdir()
    assert export(tmp_path / "run", tmp_path / "empty") == tmp_path / "empty"


def test_a_missing_base_model_leaves_nothing_behind(
    tmp_path: Path, base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    write_run(tmp_path / "run", trained_model(base), base)
    base.rename(tmp_path / "moved")
    with pytest.raises(ModelNotFoundError, match="smollm2-135m"):
        export(tmp_path / "run", tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["moved", "run"]
    # the run's configuration stands in for an adapter that names what is not there
    RunLog(tmp_path / "run").manifest(config={"model": str(tmp_path / "moved")})
    folder = export(tmp_path / "run", tmp_path / "out")
    config = json.loads((folder / "adapter_config.json").read_text())
    assert config["base_model_name_or_path"] == str(tmp_path / "moved")


def test_reward_summary() -> None:
    rows = [{"step": i, "reward": float(i)} for i in range(1, 9)]
    # first five: (1+2+3+4+5)/5 = 3; last five: (4+5+6+7+8)/5 = 6
    assert reward_summary(rows) == {"steps": 8, "first": 3.0, "last": 6.0, "best": 8.0, "best_step": 8}
    assert reward_summary([{"step": 1, "loss": 0.1}]) == {}
