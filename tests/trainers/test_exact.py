"""What a run refuses or repairs rather than train on something else than was sampled and configured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")
pytest.importorskip("peft")

from peft import LoraConfig, get_peft_model
from transformers import TrainerCallback

from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from agentspec.types import Sampling
from benchmarks.exactness import make_batch, oracle_loss, relative_error, tiny_policy, trained_tokens
from rewards import RewardSet
from tests.tiny import tiny_model, tiny_tokenizer
from tests.trainers.builders import call, episode, instead_of_playing
from tests.trainers.played import toy_trainer
from tests.trainers.test_grpo import RETURNS, conversations, our_trainer, settings
from trainers import grpo as grpo_module
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.finite import NonFiniteError, require_finite, without_dropout
from trainers.forward import rows_logprobs
from trainers.micro_batches import ROWS, collate
from trainers.sequences import Row, build_sequences


def test_a_greedy_trained_call_ends_the_run_before_its_update(tmp_path: Path, monkeypatch: Any) -> None:
    """A module's temperature that no configuration shows: log-probabilities would be divided by 0."""
    episodes = [episode([call(0, [1, i], [2, 3], temperature=0.0)], [r]) for i, r in enumerate(RETURNS)]
    trainer = our_trainer(tmp_path, episodes, monkeypatch)
    with pytest.raises(SpecError, match=r"sampled with temperature 0.0 \(reasoning.direct/act\)"):
        trainer.train()
    nucleus = Sampling(temperature=1.0, top_p=0.5)
    part = [replace(t, calls=tuple(replace(c, sampling=nucleus) for c in t.calls)) for t in episodes]
    monkeypatch.setattr(grpo_module, "collect", instead_of_playing(lambda jobs: part))
    with pytest.raises(SpecError, match=r"top_p 0.5 and top_k 0 \(reasoning.direct/act\)"):
        trainer.train()


class Spoil(TrainerCallback):
    """Puts a NaN where it is told to: into a weight before training, a gradient or a weight after an update."""

    def __init__(self, place: str) -> None:
        self.place = place

    def spoil(self, model: Any) -> None:
        parameter = next(p for p in model.parameters() if p.requires_grad)
        with torch.no_grad():
            (parameter.grad if self.place == "gradient" else parameter).view(-1)[0] = torch.nan

    def on_train_begin(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        if self.place == "loss":
            self.spoil(kwargs["model"])

    def on_pre_optimizer_step(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        if self.place == "gradient":
            self.spoil(kwargs["model"])

    def on_optimizer_step(self, args: Any, state: Any, control: Any, **kwargs: Any) -> None:
        if self.place == "weight":
            self.spoil(kwargs["model"])


@pytest.mark.parametrize("place", ["loss", "gradient", "weight"])
def test_a_number_that_is_none_ends_the_run_before_anything_is_saved(
    tmp_path: Path, monkeypatch: Any, place: str
) -> None:
    trainer = our_trainer(tmp_path, conversations(RETURNS), monkeypatch, save_strategy="steps", save_steps=1)
    trainer.callback_handler.callbacks.insert(0, Spoil(place))  # before the guard looks
    with pytest.raises(NonFiniteError, match=f"{place} of update 0 is not finite.*nothing of it was saved"):
        trainer.train()
    assert not list(tmp_path.glob("checkpoint-*")) and not list(tmp_path.rglob("*.safetensors"))


def test_what_is_finite_passes() -> None:
    require_finite("weight", [("a", torch.ones(2)), ("empty", torch.ones(0))], 0)
    require_finite("weight", [], 0)


@pytest.mark.parametrize(("accumulation", "generation"), [(4, 2), (2, 3), (2, 1)])
def test_an_update_never_mixes_generation_rounds(tmp_path: Path, accumulation: int, generation: int) -> None:
    changes = {"gradient_accumulation_steps": accumulation, "steps_per_generation": generation}
    with pytest.raises(SpecError, match=f"set steps_per_generation to {accumulation}"):
        ScaffoldConfig(**settings(tmp_path, **changes)).check()
    ScaffoldConfig(**settings(tmp_path, gradient_accumulation_steps=2, steps_per_generation=4)).check()


def test_the_entropy_bonus_is_refused(tmp_path: Path) -> None:
    """TRL would log its loss, and entropies carry no gradient here."""
    for changes in ({"entropy_coef": 0.1}, {"use_adaptive_entropy": True}):
        with pytest.raises(SpecError, match="entropy bonus has no gradient"):
            ScaffoldConfig(**settings(tmp_path, **changes)).check()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"delta": 2.0, "loss_type": "cispo"}, "delta is 2.0, which changes nothing: loss_type 'cispo' does not"),
        ({"gamma": 0.9}, "gamma is 0.9, which changes nothing: estimator 'grpo' does not read it"),
        ({"gigpo_weight": 0.5, "estimator": "reward_to_go"}, "does not read it; use gigpo"),
        ({"reference": "bse"}, "unknown reference"),
        ({"max_completion_length": 50}, "only loss_type 'dr_grpo' reads it"),
    ],
)
def test_settings_that_change_nothing_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        ScaffoldConfig(**settings(tmp_path) | changes).check()


def test_the_largest_difference_is_the_largest(tmp_path: Path, monkeypatch: Any) -> None:
    """Over micro-batches, and over rollouts without an advantage: the wrong one stands where nobody learns."""
    model = tiny_model(tiny_tokenizer())
    episodes = conversations([3.0] * 4 + RETURNS[4:])  # the first group has no variance
    true = []
    with torch.no_grad():
        for e in episodes:
            (sequence,) = build_sequences(e)
            logps, _ = rows_logprobs(model, [Row(sequence, 1.0, 0)])
            found = dict(enumerate(logps[0].tolist(), 1))
            calls, done = [], 0
            for c in e.calls:
                start = len(c.prompt_ids)
                ids = c.completions[0].token_ids
                recorded = tuple(found[start + i] for i in range(len(ids)))
                calls.append(replace(c, completions=(replace(c.completions[0], logprobs=recorded),)))
                done += len(ids)
            assert done == sequence.trained
            true.append(replace(e, calls=tuple(calls)))
    one = true[1].calls[0]
    logprobs = (one.completions[0].logprobs[0] - 0.75, *one.completions[0].logprobs[1:])
    wrong = replace(one, completions=(replace(one.completions[0], logprobs=logprobs),))
    spoiled = [*true]
    spoiled[1] = replace(true[1], calls=(wrong, *true[1].calls[1:]))
    for name, given, largest in (("true", true, 0.0), ("spoiled", spoiled, 0.75)):
        our_trainer(tmp_path / name, given, monkeypatch).train()
        (metrics,) = RunLog(tmp_path / name).read("metrics.jsonl")
        assert metrics["sampling/logp_difference_max"] == pytest.approx(largest, abs=1e-5)


def test_dropout_of_a_warm_start_is_off(tmp_path: Path, monkeypatch: Any) -> None:
    lora = LoraConfig(r=2, lora_alpha=4, lora_dropout=0.5, target_modules=["q_proj", "v_proj"], init_lora_weights=False)
    model = get_peft_model(tiny_model(tiny_tokenizer(), attention_dropout=0.3), lora)
    rows = [Row(s, 1.0, i) for i, e in enumerate(conversations(RETURNS)) for s in build_sequences(e)]
    sampled = rows_logprobs(model.eval(), rows)[0]
    model.train()
    assert (rows_logprobs(model, rows)[0] - sampled).abs().max() > 0.01
    trainer = our_trainer(tmp_path, conversations(RETURNS), monkeypatch, model)
    trainer.model.train()
    for packing in ("padded", "tree"):
        assert (rows_logprobs(trainer.model, rows, packing=packing)[0] - sampled).abs().max() < 1e-5
    without_dropout(model)  # once more changes nothing
    assert model.peft_config["default"].lora_dropout == 0.5  # what is saved says what the adapter was made with


@pytest.mark.parametrize("reference", ["initial", "base"])
def test_the_reference_is_the_one_named(tmp_path: Path, monkeypatch: Any, reference: str) -> None:
    """A warm start is away from its base: against itself the divergence is 0, against the base it is not."""
    torch.manual_seed(1)
    lora = LoraConfig(r=2, lora_alpha=64, target_modules=["q_proj", "v_proj"], init_lora_weights=False)
    base = tiny_model(tiny_tokenizer())
    model = get_peft_model(tiny_model(tiny_tokenizer()), lora)
    trainer = our_trainer(tmp_path, conversations(RETURNS), monkeypatch, model, beta=0.1, reference=reference)
    trainer.train()
    batch = trainer._buffered_inputs[0]
    rows = batch[ROWS]
    mask = collate(rows, 0)["tool_mask"]
    with torch.no_grad():
        of_base = rows_logprobs(base, rows)[0]
    assert ((batch["ref_per_token_logps"] - of_base).abs() * mask).max() < 1e-5 or reference == "initial"
    (metrics,) = RunLog(tmp_path).read("metrics.jsonl")
    assert metrics["kl"] == pytest.approx(0.0, abs=1e-9) if reference == "initial" else metrics["kl"] > 1e-6


def test_rewards_are_computed_once_per_episode(tmp_path: Path, monkeypatch: Any) -> None:
    calls: list[str] = []
    values = RewardSet._values

    def counted(self: RewardSet, name: str, trajectory: Any) -> Any:
        calls.append(f"{name} {trajectory.episode}")
        return values(self, name, trajectory)

    monkeypatch.setattr(RewardSet, "_values", counted)
    toy_trainer(tmp_path, rewards={"env": 1.0, "invalid_action": 0.1}, max_steps=1).train()
    assert len(calls) == len(set(calls)) == 2 * 4  # two rewards, four episodes


@pytest.mark.parametrize("loss_type", ["dr_grpo", "dppo", "bnpo"])
def test_the_audit_knows_what_each_loss_divides_by(tmp_path: Path, loss_type: str) -> None:
    toy_trainer(tmp_path, loss_type=loss_type, estimator="max_rl", rewards={"env": 1.0}, max_steps=1).train()
    (finding,) = audit(tmp_path)
    assert finding.violations == []
    expected = 4 * ScaffoldConfig.max_completion_length if loss_type == "dr_grpo" else finding.trained
    assert finding.denominator == expected > 0


def test_no_optimiser_step_is_empty_while_rows_are_left(tmp_path: Path, monkeypatch: Any) -> None:
    """Nine rows in eight one-step micro-batches were 2, 2, 2, 2, 1, 0, 0, 0."""
    episodes = conversations(RETURNS)
    extra = call(9, [200, 201], [7, 8])
    episodes[0] = replace(episodes[0], calls=(*episodes[0].calls, extra))
    changes = {"per_device_train_batch_size": 1, "gradient_accumulation_steps": 1, "steps_per_generation": 8}
    trainer = our_trainer(tmp_path, episodes, monkeypatch, **changes)
    trainer.train()
    filled = [sum(r.episode >= 0 for r in batch[ROWS]) for batch in trainer._buffered_inputs]
    assert sorted(filled) == [1] * 7 + [2]
    (receipt,) = RunLog(tmp_path).read("updates.jsonl")
    assert len(receipt["rows"]) == 9 and json.dumps(receipt)


@pytest.mark.parametrize(
    ("loss_type", "estimator", "packing"),
    [
        ("dapo", "gigpo", "tree"),
        ("dppo", "max_rl", "padded"),
        ("dr_grpo", "reward_to_go", "tree"),
        ("bnpo", "rloo", "tree"),
    ],
)
def test_gradients_are_those_of_the_written_out_formulas(loss_type: str, estimator: str, packing: str) -> None:
    """Four of the cases of `python -m benchmarks.exactness`, whose oracle shares no numerics with the trainer."""
    assert relative_error({"loss_type": loss_type, "estimator": estimator, "packing": packing}) < 1e-5


def test_the_oracle_sees_another_objective() -> None:
    """What it compares is not equal whatever the trainer does."""
    config = {"loss_type": "dapo", "estimator": "grpo", "packing": "tree"}
    model, base = tiny_policy(lora=False)
    batch = make_batch(model.double(), 0)
    values = [
        float(oracle_loss(trained_tokens(model, base, batch, config | c), config | c, len(batch)).detach())
        for c in ({}, {"estimator": "rloo"}, {"loss_type": "dppo"}, {"overlong": "keep"}, {"normalize": "rollout"})
    ]
    assert len({round(v, 6) for v in values}) == len(values)
