"""The policy to train: a base model from the resolver, with a LoRA adapter, new or warm-started; or with two of them.

The adapter under training is always PEFT's `default` one, so that saving, resuming and exporting find it where they
look; a second, frozen one lies in a folder of its own name beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from agentspec.actions import suggest
from agentspec.llm.base import LLMError
from agentspec.llm.models import resolve_adapter
from agentspec.registry import SpecError
from trainers.config import ScaffoldConfig

TRAINED, ACTOR = "default", "actor"
"""Names of the adapter that is trained, and of the frozen one that acts beside a trained reflector."""


def load_policy(config: ScaffoldConfig) -> tuple[nn.Module, Any]:
    """Model and tokenizer of `config`.

    float32 on a CPU (bfloat16 is slower there), bfloat16 where the config says `bf16`. With `lora_r: 0` all
    weights are trained.
    """
    if config.actor_adapter:
        raise SpecError(
            f"actor_adapter {config.actor_adapter!r} is a frozen actor beside a trained reflector, and none is trained "
            "here; name it in `adapter` to train it, or use recipes/retroformer_delivery.py"
        )
    return _load(config, {TRAINED: config.adapter} if config.adapter or config.lora_r else {})


def load_actor_and_reflector(config: ScaffoldConfig, run: str | Path = "") -> tuple[nn.Module, Any]:
    """One base with two adapters, and the tokenizer: the actor's, frozen, and the reflector's, active and trainable.

    Args:
    config: `actor_adapter` is the actor's (empty: a LoRA that nobody trains adds nothing, so the base model acts),
        `adapter` what the reflector starts from (empty: a new LoRA, which says what the base model says).
    run: folder of a training run or of its checkpoint: both adapters come from there.
    """
    if run:
        return _load(config, {ACTOR: str(Path(run) / ACTOR), TRAINED: str(run)})
    return _load(config, {ACTOR: config.actor_adapter, TRAINED: config.adapter})


def _load(config: ScaffoldConfig, adapters: Mapping[str, str]) -> tuple[nn.Module, Any]:
    """The base model with its tokenizer, and on it adapters by name, each from where it says or (empty) a new one.

    Raises:
    LLMError: the model or an adapter cannot be found.
    """
    from peft import PeftModel, get_peft_model
    from transformers import AutoModelForCausalLM, AutoTokenizer

    from agentspec.llm.chat import set_template_kwargs
    from agentspec.llm.models import quiet, resolve

    found = {name: resolve_adapter(adapter) if adapter else "" for name, adapter in adapters.items()}
    path = resolve(config.model).path
    dtype = torch.bfloat16 if config.bf16 and not config.use_cpu else torch.float32
    with quiet():
        model, tokenizer = AutoModelForCausalLM.from_pretrained(path, dtype=dtype), AutoTokenizer.from_pretrained(path)
    # Every prompt of the run is rendered with this tokenizer: rollouts on all backends, demonstrations, validation.
    set_template_kwargs(tokenizer, config.chat_template_kwargs or {})
    new = {name: _new_lora(model, config) for name, adapter in found.items() if not adapter}
    torch.manual_seed(config.seed)
    for name, adapter in found.items():
        first, trained = not isinstance(model, PeftModel), name == TRAINED
        try:
            if adapter and first:
                model = PeftModel.from_pretrained(model, adapter, adapter_name=name, is_trainable=trained)
            elif adapter:
                model.load_adapter(adapter, name, is_trainable=trained)
            elif first:
                model = get_peft_model(model, new[name], adapter_name=name)
            else:
                model.add_adapter(name, new[name])
        except (OSError, ValueError) as error:
            raise LLMError(f"adapter {adapter or name!r} cannot be loaded: {error}") from error
    if found:
        model.set_adapter(TRAINED)  # which also freezes the other one
        for lora in model.peft_config.values():  # a shipped adapter names its base by alias, which PEFT cannot find
            lora.base_model_name_or_path = path
    return model, tokenizer


def _new_lora(model: Any, config: ScaffoldConfig) -> Any:
    """Configuration of a new adapter for `model`, which has such modules and as many layers (else `SpecError`)."""
    from peft import LoraConfig

    layers = model.config.get_text_config().num_hidden_layers
    if not 0 <= config.lora_layers <= layers:
        raise SpecError(f"lora_layers is {config.lora_layers}; {config.model} has {layers} layers (0 means all)")
    top = list(range(layers - config.lora_layers, layers)) if config.lora_layers else None
    return LoraConfig(
        layers_to_transform=top,
        r=config.lora_r,
        lora_alpha=config.lora_alpha or 2 * config.lora_r,
        target_modules=_targets(model, config),
        lora_dropout=0.0,  # dropout would make the update's log-probabilities differ from the sampled ones
        task_type="CAUSAL_LM",
    )


def _targets(model: Any, config: ScaffoldConfig) -> list[str]:
    """Names of the modules that carry LoRA; `all-linear` is every linear layer except the output projection."""
    names = [name for name, _ in model.named_modules()]
    if config.lora_targets != ["all-linear"]:
        there = {name.rpartition(".")[2] for name in names}
        for target in config.lora_targets or [""]:
            if not any(f".{name}".endswith(f".{target}") for name in names) or not target:
                raise SpecError(f"lora_targets: {config.model} has no module {target!r}{suggest(target, there)}")
        return config.lora_targets
    head, named = model.get_output_embeddings(), model.named_modules()
    return sorted({n.rpartition(".")[2] for n, m in named if isinstance(m, nn.Linear) and m is not head})
