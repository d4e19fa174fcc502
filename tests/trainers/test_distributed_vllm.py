"""Training with vLLM through TRL's own ``VLLMGeneration``: current weights every round, awake and asleep, corrected."""

from __future__ import annotations

import inspect
import os
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from peft import LoraConfig, get_peft_model
from trl import GRPOTrainer
from trl.generation.vllm_client import VLLMClient
from trl.generation.vllm_generation import VLLMGeneration

from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from rewards.base import REWARDS, RewardEntry
from tests.tiny import tiny_model, tiny_tokenizer
from tests.trainers import played
from tests.trainers.fake_vllm import FakeVLLM, use_fake_vllm
from tests.trainers.played import toy_tasks, toy_trainer
from trainers.audit import audit
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.vllm import BATCH_INVARIANT, base_kept, importance_ratio, prepare_vllm


def adapted_model(tokenizer: Any, **changes: Any) -> Any:
    """The tiny model with an adapter that changes what it says (by default B is zero)."""
    lora = LoraConfig(r=2, lora_alpha=4, target_modules=["q_proj", "v_proj"])
    model = get_peft_model(tiny_model(tokenizer, **changes), lora)
    for name, parameter in model.named_parameters():
        if "lora_B" in name:
            torch.nn.init.normal_(parameter, generator=torch.Generator().manual_seed(1))
    return model


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch) -> Any:
    """folder, settings -> a trainer whose policy (with an adapter unless ``lora=False``) samples through vLLM."""
    monkeypatch.setitem(REWARDS, "token_sum", RewardEntry("tests.trainers.fake_vllm:token_sum", "for tests"))

    def make(folder: Path, *, lora: bool = True, bias: float = 0.0, **changes: Any) -> ScaffoldGRPOTrainer:
        use_fake_vllm(monkeypatch, tiny_tokenizer().eos_token_id, bias)
        monkeypatch.setattr(played, "tiny_model", adapted_model if lora else tiny_model)
        settings = {"rewards": {"token_sum": 1.0}, "use_vllm": True, "optim": "sgd", "max_grad_norm": 0.0, **changes}
        return toy_trainer(folder, toy_tasks(menu=False), **settings)

    return make


def metric(folder: Path, name: str) -> list[float]:
    return [r[name] for r in RunLog(folder).read("metrics.jsonl")]


@pytest.mark.parametrize("lora", [True, False])
@pytest.mark.parametrize("sleep", [False, True])
def test_every_round_samples_from_the_current_weights(tmp_path: Path, trainer: Any, lora: bool, sleep: bool) -> None:
    run = trainer(tmp_path, lora=lora, vllm_enable_sleep_mode=sleep, max_steps=3)
    base = {n: p.clone() for n, p in run.model.named_parameters() if ".base_layer." in n}
    run.train()
    assert max(metric(tmp_path, "sampling/logp_difference_max")) < 1e-4
    assert min(metric(tmp_path, "grad_norm")) > 0  # the weights did change between the rounds
    engine: FakeVLLM = run.vllm_generation.llm
    assert engine.pushes == 3
    assert (engine.awake == set()) == sleep
    assert bool(base) == lora
    assert all(torch.equal(p, base[n]) for n, p in run.model.named_parameters() if n in base)
    receipts = list(audit(tmp_path))
    assert receipts and not [v for r in receipts for v in r.violations]


def test_a_resumed_run_pushes_its_weights(tmp_path: Path, trainer: Any) -> None:
    settings = {"max_steps": 3, "save_strategy": "steps", "save_steps": 1, "lr_scheduler_type": "constant"}
    whole = trainer(tmp_path / "a", **settings)
    whole.train()
    trainer(tmp_path / "b", **{**settings, "max_steps": 1}).train()
    resumed = trainer(tmp_path / "b", **settings)
    resumed.train(resume_from_checkpoint=str(tmp_path / "b" / "checkpoint-1"))
    assert max(metric(tmp_path / "b", "sampling/logp_difference_max")) < 1e-4
    expected = dict(whole.model.named_parameters())
    assert all(torch.equal(p, expected[n]) for n, p in resumed.model.named_parameters())


def test_an_engine_that_slept_is_given_the_weights_again(tmp_path: Path, trainer: Any) -> None:
    run = trainer(tmp_path, vllm_enable_sleep_mode=True)
    rows = run.train_dataset
    first = run.evaluate(eval_dataset=rows)
    again = run.evaluate(eval_dataset=rows)  # no update in between
    assert run.vllm_generation.llm.pushes == 2
    assert first["eval_reward"] == again["eval_reward"] and first["eval_unscorable"] == 0
    awake = trainer(tmp_path)
    awake.evaluate(eval_dataset=rows)
    assert awake.evaluate(eval_dataset=rows)["eval_reward"] == first["eval_reward"]
    assert awake.vllm_generation.llm.pushes == 1


def test_what_vllm_samples_otherwise_is_weighed(tmp_path: Path, trainer: Any) -> None:
    """Reported log-probabilities too low by ln 2: each token was sampled half as often as it is likely now."""

    def step(name: str, **changes: Any) -> torch.Tensor:
        run = trainer(tmp_path / name, max_steps=1, bias=-0.6931472, **changes)
        before = [p.detach().clone() for p in run.model.parameters()]
        run.train()
        return torch.cat([(a - b).flatten() for a, b in zip(run.model.parameters(), before, strict=True)])

    plain = step("off", vllm_importance_sampling_correction=False)
    assert plain.abs().max() > 1e-4
    for name, changes, factor in (
        ("on", {}, 2.0),
        ("clipped", {"vllm_importance_sampling_clip_max": 1.5}, 1.5),
        ("masked", {"vllm_importance_sampling_clip_max": 1.5, "vllm_importance_sampling_mode": "token_mask"}, 0.0),
    ):
        torch.testing.assert_close(step(name, **changes), factor * plain, atol=2e-6, rtol=1e-3)


def test_trl_s_figures_of_vllm_are_logged_under_its_names(tmp_path: Path, trainer: Any) -> None:
    trainer(tmp_path, max_steps=1, bias=-0.6931472).train()
    (metrics,) = (r for r in RunLog(tmp_path).read("metrics.jsonl") if "reward" in r)
    stock = re.findall(r'"(sampling/[\w/]+)"', inspect.getsource(GRPOTrainer._generate_and_score_completions))
    assert len(stock) == 5 and set(stock) <= set(metrics)
    # Every token was reported ln 2 less likely than it is: a ratio of 2.
    for name in stock:
        assert metrics[name] == pytest.approx(0.6931472 if "difference" in name else 2.0, abs=1e-3), name
    trainer(tmp_path / "off", max_steps=1, vllm_importance_sampling_correction=False).train()
    (metrics,) = (r for r in RunLog(tmp_path / "off").read("metrics.jsonl") if "reward" in r)
    assert not set(stock) & set(metrics) and "sampling/logp_difference_max" in metrics


def test_importance_ratio() -> None:
    logps = torch.tensor([[0.0, -1.0, -2.0, 0.0]], requires_grad=True)
    sampled = torch.tensor([[0.0, -2.0, -1.0, -90.0]])
    mask = torch.tensor([[1, 1, 1, 0]])
    # exp of 0, 1, -1; the last is not trained. Bounds 0.5 .. 2.
    kept = importance_ratio(logps, sampled, mask, "token_truncate", 0.5, 2.0)
    assert kept.tolist() == [[1.0, 2.0, 0.5, 1.0]] and not kept.requires_grad
    assert importance_ratio(logps, sampled, mask, "token_mask", 0.5, 2.0).tolist() == [[1.0, 0.0, 0.0, 1.0]]
    free = importance_ratio(logps, sampled, mask, "token_truncate", None, None)
    torch.testing.assert_close(free, torch.tensor([[1.0, 2.7182818, 0.36787944, 1.0]]))


def test_merging_an_adapter_leaves_the_base_as_it_was() -> None:
    model = adapted_model(tiny_tokenizer()).to(torch.bfloat16)
    weights = {n: p for n, p in model.named_parameters() if ".base_layer." in n}
    before = {n: p.detach().clone() for n, p in weights.items()}
    with base_kept(model):
        model.merge_adapter()
        assert not all(torch.equal(weights[n], before[n]) for n in weights)
        model.unmerge_adapter()
        assert not all(torch.equal(weights[n], before[n]) for n in weights)  # it rounds
    assert weights and all(torch.equal(weights[n], before[n]) for n in weights)


def test_what_cannot_work_with_vllm_is_refused(tmp_path: Path, trainer: Any) -> None:
    for changes, reason in (
        ({"vllm_tensor_parallel_size": 2}, "vllm_mode: server"),
        ({"vllm_importance_sampling_mode": "sequence_mask"}, "speaks of rows"),
        ({"vllm_batch_invariant": True, "use_vllm": False}, "set `use_vllm: true`"),
        ({"vllm_batch_invariant": True, "vllm_mode": "server"}, "VLLM_BATCH_INVARIANT=1 vllm serve"),
        ({"vllm_batch_invariant": True}, "no CUDA device"),
    ):
        with pytest.raises(SpecError, match=reason):
            trainer(tmp_path, **changes)


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("capability", [(8, 0), (7, 5)])
def test_vllm_is_asked_to_be_batch_invariant_where_it_can_be(
    seen: bool, capability: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    envs: Any = ModuleType("vllm.envs")
    envs.__getattr__ = lambda name: seen and os.environ.get(name) == "1"
    monkeypatch.setitem(sys.modules, "vllm.envs", envs)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: capability)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a GPU")
    monkeypatch.setenv(BATCH_INVARIANT, "0")
    config: Any = SimpleNamespace(vllm_batch_invariant=True)
    if capability < (8, 0):
        with pytest.raises(SpecError, match="found a GPU"):
            prepare_vllm(config)
        assert os.environ[BATCH_INVARIANT] == "0"
    elif not seen:
        with pytest.raises(SpecError, match="reads it when it is imported"):
            prepare_vllm(config)
    else:
        prepare_vllm(config)
        assert os.environ[BATCH_INVARIANT] == "1"
    monkeypatch.setenv(BATCH_INVARIANT, "0")
    prepare_vllm(SimpleNamespace(vllm_batch_invariant=False))  # type: ignore[arg-type]
    assert os.environ[BATCH_INVARIANT] == "0"


def test_trl_has_what_is_used_of_it() -> None:
    """The seams to TRL that a fake engine replaces, or that only a server reaches."""
    inspect.signature(VLLMClient.__init__).bind(None, base_url="http://x", connection_timeout=1.0)
    settings = {"n": 1, "temperature": 1.0, "top_p": 1.0, "top_k": 0, "max_tokens": 1, "logprobs": 0}
    inspect.signature(VLLMClient.generate).bind(None, [[1]], **settings, generation_kwargs={"seed": 1})
    inspect.signature(VLLMClient.get_server_info).bind(None)
    started = set(VLLMGeneration._init_vllm.__code__.co_names)
    assert {"vllm_client", "llm", "_llm_weights_sleeping", "is_main_process"} <= started
    made = set(VLLMGeneration.__init__.__code__.co_names)
    wanted = {"mode", "model", "accelerator", "enable_sleep_mode", "server_base_url", "server_host", "server_port"}
    assert wanted | {"server_timeout"} <= made
    assert {"completion_ids", "logprobs", "logprob_token_ids"} <= set(_constants(VLLMClient.generate))


def _constants(function: Any) -> list[str]:
    """All string constants of a function, those in tuples (keys of literals) among them."""
    names: list[str] = []
    for constant in function.__code__.co_consts:
        names += [c for c in (constant if isinstance(constant, tuple) else (constant,)) if isinstance(c, str)]
    return names
