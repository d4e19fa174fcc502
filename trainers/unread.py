"""Settings that change nothing, since no configuration reads them or not this one: refused unless they are defaults."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from trainers.estimators import ESTIMATORS, estimator
from trainers.fields import defaults, field_rules
from trainers.losses import loss
from trainers.writes import write_credit

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig

REFLECTION = "retroformer"
SHAPE = "lora_alpha lora_targets lora_layers"
WEIGHTED = "vllm_importance_sampling_mode vllm_importance_sampling_clip_max vllm_importance_sampling_clip_min"
SERVER = "vllm_server_base_url vllm_server_host vllm_server_port vllm_server_timeout vllm_group_port"
COLOCATED = (
    "vllm_model_impl vllm_enable_sleep_mode vllm_gpu_memory_utilization vllm_max_model_length vllm_tensor_parallel_size"
)


def unread_with_a_value(config: ScaffoldConfig) -> Iterator[str]:
    """What is set and not read, with what to set instead."""
    from trl import GRPOConfig

    for name, rule in field_rules(GRPOConfig).items():
        value = getattr(config, name, rule.allowed[0] if rule.allowed else None)
        if rule.status != "used" and value not in rule.allowed:
            verb = "is not read" if rule.status == "refused" else f"must be {rule.allowed[0]!r}"
            yield f"{name} is {value!r}, and it {verb}: {rule.why}"
    default = defaults(type(config))
    for name, why in unread(config).items():
        if getattr(config, name) != default[name]:
            yield f"{name} is {getattr(config, name)!r}, which changes nothing: {why}; or leave it out"


def unread(config: ScaffoldConfig) -> dict[str, str]:
    """Fields that this configuration does not read -> what would make it read them."""
    objective, writes = loss(config.loss_type), write_credit(config.write_credit)
    needs = estimator(config.estimator).needs
    vllm, colocated = config.use_vllm, config.use_vllm and config.vllm_mode == "colocate"
    readers = {n: ", ".join(e.name for e in ESTIMATORS.values() if n in e.needs) for n in ("gamma", "gigpo_weight")}
    reflects, carries = config.spec.reflection.name == REFLECTION, config.spec.scope == "run"
    length = "only loss_type 'dr_grpo' reads it; answers end by `agent: {sampling: {max_tokens: ...}}`"
    without = "set `use_vllm: true` (the local backend tries out by itself whether a device is batch-invariant)"
    rows: list[tuple[Any, str, str]] = [
        ("max_completion_length" in objective.uses, "max_completion_length", length),
        ("delta" in objective.uses, "delta", f"loss_type {objective.name!r} does not read it"),
        ("epsilon" in objective.uses or not config.epsilon_high, "epsilon", f"{objective.name!r} reads epsilon_high"),
        (config.beta, "reference", "beta is 0; set it"),
        *((n in needs, n, f"estimator {config.estimator!r} does not read it; use {r}") for n, r in readers.items()),
        (writes.function, "write_calls", "write_credit is 'episode'; choose another"),
        ("write_rerolls" in writes.reads, "write_rerolls write_points", "set `write_credit: local`"),
        (not config.adapter, f"lora_r {SHAPE}", "beside adapter, whose own shape is trained; set `adapter: ''`"),
        (config.lora_r or config.adapter, SHAPE, "lora_r 0 trains all weights; give it a rank"),
        (reflects, "actor_adapter actor_temperature", f"no actor is frozen without `reflection: {REFLECTION}`"),
        (config.scaffolds is not None, "held_out scaffold_groups", "there is one scaffold; set `scaffolds`"),
        (carries, "memory_carry", "no memory outlives its episode; set `agent: {scope: run}`"),
        (config.validates, "validation_tasks validation_specs", "nothing is validated; set `eval_strategy: steps`"),
        (vllm, f"vllm_mode vllm_batch_invariant vllm_importance_sampling_correction {WEIGHTED}", without),
        (colocated, COLOCATED, "only a colocated vLLM reads it; set `use_vllm: true` and `vllm_mode: colocate`"),
        (vllm and not colocated, SERVER, "only with a server is it read; set `vllm_mode: server`"),
        (config.vllm_importance_sampling_correction, WEIGHTED, "set `vllm_importance_sampling_correction: true`"),
    ]
    return {name: why for read, names, why in rows if not read for name in names.split()}
