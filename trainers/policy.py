"""The policy to train: a base model from the resolver, with a LoRA adapter, new or warm-started."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn

from agentspec.llm.base import LLMError
from agentspec.registry import SpecError
from trainers.config import ScaffoldConfig


def load_policy(config: ScaffoldConfig) -> tuple[nn.Module, Any]:
    """Model and tokenizer of ``config``.

    float32 on a CPU (bfloat16 is slower there), bfloat16 where the config says ``bf16``. With ``lora_r: 0`` all
    weights are trained.

    Raises:
        LLMError: the model or adapter cannot be found.
        SpecError: an adapter together with ``lora_r: 0``.
    """
    from peft import LoraConfig, PeftModel, get_peft_model
    from transformers import AutoModelForCausalLM, AutoTokenizer

    from agentspec.llm.models import resolve

    if config.adapter and config.lora_r == 0:
        raise SpecError(f"adapter {config.adapter!r} with lora_r 0: set lora_r to the adapter's rank, or merge it")
    adapter = resolve_adapter(config.adapter) if config.adapter else ""
    source = resolve(config.model)
    dtype = torch.bfloat16 if config.bf16 and not config.use_cpu else torch.float32
    tokenizer = AutoTokenizer.from_pretrained(source.path)
    model = AutoModelForCausalLM.from_pretrained(source.path, dtype=dtype)
    if adapter:
        try:
            policy = PeftModel.from_pretrained(model, adapter, is_trainable=True)
            # A shipped adapter names its base by alias; what is saved must name what PEFT itself can find.
            policy.peft_config["default"].base_model_name_or_path = str(source.path)
            return policy, tokenizer
        except (OSError, ValueError) as error:
            raise LLMError(f"adapter {config.adapter!r} cannot be loaded: {error}") from error
    if config.lora_r == 0:
        return model, tokenizer
    layers = model.config.get_text_config().num_hidden_layers
    if not 0 <= config.lora_layers <= layers:
        raise SpecError(f"lora_layers is {config.lora_layers}; {config.model} has {layers} layers (0 means all)")
    top = list(range(layers - config.lora_layers, layers)) if config.lora_layers else None
    lora = LoraConfig(
        layers_to_transform=top,
        r=config.lora_r,
        lora_alpha=config.lora_alpha or 2 * config.lora_r,
        target_modules=_targets(model, config),
        lora_dropout=0.0,  # dropout would make the update's log-probabilities differ from the sampled ones
        task_type="CAUSAL_LM",
    )
    torch.manual_seed(config.seed)
    return get_peft_model(model, lora), tokenizer


def _targets(model: nn.Module, config: ScaffoldConfig) -> list[str]:
    """Names of the modules that carry LoRA; ``all-linear`` is every linear layer except the output projection."""
    if config.lora_targets != ["all-linear"]:
        return config.lora_targets
    wrapper: Any = model
    head = wrapper.get_output_embeddings()
    named = model.named_modules()
    return sorted({n.rpartition(".")[2] for n, m in named if isinstance(m, nn.Linear) and m is not head})


def resolve_adapter(name: str) -> str:
    """A PEFT adapter: a folder, the name of one that ships with ``trainers``, or a hub id (``owner/name``).

    Raises:
        LLMError: none of these.
    """
    shipped = Path(__file__).parent / "adapters"
    bundled = shipped / name
    if (bundled / "adapter_config.json").is_file():
        return str(bundled)
    if (Path(name) / "adapter_config.json").is_file() or (name.count("/") == 1 and not Path(name).exists()):
        return name
    names = sorted(p.parent.name for p in shipped.glob("*/adapter_config.json"))
    raise LLMError(
        f"adapter {name!r} is no folder with an adapter_config.json, and none that ships ({', '.join(names) or 'none'})"
    )
