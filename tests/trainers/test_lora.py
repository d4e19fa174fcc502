"""LoRA layers computed merged: PEFT's values and gradients."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from agentspec.registry import SpecError
from tests.tiny import tiny_model, tiny_tokenizer
from tests.trainers.builders import CPU_RUN
from tests.trainers.test_frozen import upper_lora
from trainers.config import ScaffoldConfig
from trainers.lora import merged_lora
from trainers.policy import _new_lora

IDS = torch.arange(24).reshape(2, 12)


def update(model: Any, merged: bool) -> list[torch.Tensor]:
    """Logits, and gradients of the log-probabilities of some tokens."""
    model.zero_grad()
    if merged:
        with merged_lora(model):
            logits = model(input_ids=IDS, use_cache=False).logits
    else:
        logits = model(input_ids=IDS, use_cache=False).logits
    logits.log_softmax(-1).gather(2, (IDS + 7)[..., None]).sum().backward()
    return [logits.detach(), *(p.grad.clone() for p in model.parameters() if p.grad is not None)]


@pytest.mark.parametrize("config", [{}, {"attention_bias": True}], ids=str)
def test_values_and_gradients_are_those_of_peft(config: dict[str, Any]) -> None:
    model = upper_lora("padded", **config)
    for name, parameter in model.named_parameters():
        if name.endswith("bias"):
            torch.nn.init.normal_(parameter)
    theirs, ours = update(model, merged=False), update(model, merged=True)
    exact = update(model.double(), merged=False)
    assert len(theirs) == len(ours) == 1 + 2 * 2 * 7
    for peft, merged, truth in zip(theirs, ours, exact, strict=True):
        of_peft, of_ours = (float((g - truth).norm() / truth.norm()) for g in (peft, merged))
        assert of_ours <= max(1e-5, 3 * of_peft)  # as exact as PEFT's, where a gradient is small by cancellation too


def test_layers_are_themselves_again() -> None:
    model = upper_lora("padded")
    with merged_lora(model):
        inside = [m for m in model.modules() if "forward" in vars(m)]
    assert len(inside) == 2 * 7 and all(hasattr(m, "lora_A") for m in inside)
    assert not any("forward" in vars(m) for m in inside)


def test_what_is_not_plain_stays_with_peft() -> None:
    model = upper_lora("padded")
    for off in (lambda: model.gradient_checkpointing_enable(), lambda: model.to(torch.bfloat16)):
        off()
        with merged_lora(model):
            assert not any("forward" in vars(m) for m in model.modules() if hasattr(m, "lora_A"))
        model.gradient_checkpointing_disable()
    with model.disable_adapter(), merged_lora(model):
        assert not any("forward" in vars(m) for m in model.modules() if hasattr(m, "lora_A"))


def test_targets_that_the_model_lacks_are_named(tmp_path: Path) -> None:
    model = tiny_model(tiny_tokenizer())
    for targets, message in ((["q_projj"], "no module 'q_projj'; did you mean q_proj"), ([], "no module ''")):
        config = ScaffoldConfig(output_dir=str(tmp_path), lora_targets=targets, **CPU_RUN)
        with pytest.raises(SpecError, match=message):
            _new_lora(model, config)
    config = ScaffoldConfig(output_dir=str(tmp_path), lora_targets=["self_attn.q_proj"], **CPU_RUN)
    assert _new_lora(model, config).target_modules == {"self_attn.q_proj"}
