"""What becomes of every field that `ScaffoldConfig` inherits from TRL's `GRPOConfig`.

A field that nobody reads would be a setting without effect, so each one is *used* (by TRL, transformers, accelerate or
this package), *fixed* (only one value is exact here), or *refused* with the place where it is set instead. A test
compares this table with the installed TRL: a version that adds a field fails it until the field has its row.
`docs/update_training_fields.py` writes the page of the documentation from it.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from typing import Any, Literal


@dataclass(frozen=True)
class FieldRule:
    """What becomes of one inherited field.

    Args:
        status: `used`, `fixed` (to the values of `allowed`) or `refused`.
        why: who reads it; or why not, and what to set instead.
        allowed: values that a fixed or refused field may have, its default among them.
    """

    status: Literal["used", "fixed", "refused"]
    why: str
    allowed: tuple[Any, ...] = ()


USED = {
    "run and its folder": "output_dir run_name seed full_determinism use_cpu restore_callback_states_from_checkpoint "
    "push_to_hub hub_model_id hub_strategy hub_token hub_private_repo hub_always_push hub_revision",
    "rollouts and updates": "num_generations per_device_train_batch_size gradient_accumulation_steps "
    "steps_per_generation generation_batch_size num_iterations max_steps num_train_epochs shuffle_dataset "
    "chat_template_kwargs",
    "loss": "loss_type beta epsilon epsilon_high delta top_entropy_quantile use_bias_correction_kl "
    "max_completion_length",
    "optimiser and schedule": "learning_rate lr_scheduler_type lr_scheduler_kwargs warmup_steps optim optim_args "
    "optim_target_modules weight_decay adam_beta1 adam_beta2 adam_epsilon max_grad_norm",
    "precision and memory": "bf16 fp16 tf32 gradient_checkpointing gradient_checkpointing_kwargs "
    "activation_checkpointing activation_checkpointing_kwargs torch_empty_cache_steps disable_dropout",
    "logs": "logging_strategy logging_steps logging_first_step logging_nan_inf_filter log_on_each_node log_level "
    "log_level_replica disable_tqdm report_to project trackio_space_id trackio_bucket_id trackio_static_space_id "
    "skip_memory_metrics debug",
    "checkpoints and evaluation while training": "save_strategy save_steps save_total_limit save_on_each_node "
    "eval_strategy eval_steps eval_delay eval_on_start load_best_model_at_end metric_for_best_model greater_is_better",
    "several processes": "accelerator_config parallelism_config ddp_find_unused_parameters ddp_bucket_cap_mb "
    "ddp_broadcast_buffers ddp_static_graph ddp_backend ddp_timeout fsdp fsdp_config deepspeed local_rank "
    "dataloader_drop_last dataloader_num_workers dataloader_pin_memory dataloader_persistent_workers "
    "dataloader_prefetch_factor dataloader_multiprocessing_context dataloader_in_order",
    "vLLM": "use_vllm vllm_mode vllm_model_impl vllm_enable_sleep_mode vllm_server_base_url vllm_server_host "
    "vllm_server_port vllm_server_timeout vllm_group_port vllm_gpu_memory_utilization vllm_max_model_length "
    "vllm_tensor_parallel_size vllm_importance_sampling_correction vllm_importance_sampling_mode "
    "vllm_importance_sampling_clip_max vllm_importance_sampling_clip_min",
}
"""Heading -> names of the fields that are read."""

FIXED = {
    "importance_sampling_level": ("a ratio per sequence speaks of rows, not of episodes", ("token",)),
    "multi_objective_aggregation": ("rewards are summed before they are compared", ("sum_then_normalize",)),
    "scale_rewards": ("set `estimator`: `grpo` scales by the group's deviation, `centred` does not", ("group",)),
    "mask_truncated_completions": ("set `overlong` for episodes, `mask_truncated` for calls", (False,)),
    "remove_unused_columns": ("the task of a row is a column that no model reads", (False,)),
    "num_generations_eval": ("validation plays each task once", (None, 1)),
    "save_only_model": ("a run resumed without its optimiser's state would not be the same run", (False,)),
    "ignore_data_skip": ("a run resumed at the first task would not be the same run", (False,)),
}
"""Field -> why it has one value, and that value (with what the configuration itself puts there)."""

_SAMPLING = "the agent samples, not TRL: set it under `agent: {sampling: {...}}`"
_MODEL = "the policy is loaded by `model`, `adapter` and `bf16`"
_EVALUATION = "evaluation plays episodes: set `validation_tasks`, `eval_sampling`, `rollout_concurrency`"
_ENTROPY = "an entropy bonus has no gradient here; explore by `agent: {sampling: {temperature: ...}}`"
_EPISODES = "episodes are recorded whole in `trajectories/`; `agentspec view` prints them"
_DATA = "rows of the data are tasks, drawn by TRL's sampler under `seed`"
_LOSSES = "the loss it belongs to is not offered; see `loss_type`"
_KERNEL = "log-probabilities of the update must be those of the rollout, from the same forward"
_ENGINE = "transformers' generation is not used: set `batching`, `rollout_concurrency` or `use_vllm`"
_SCRIPT = "no script reads it: a recipe trains, validates (`eval_strategy`) and ends"

REFUSED = {
    _SAMPLING: "temperature top_p top_k min_p repetition_penalty generation_kwargs vllm_structured_outputs_regex",
    "weights belong to names: set `rewards: {name: weight}`": "reward_weights",
    _MODEL: "model_init_kwargs",
    "code that comes with a model is not run; convert the model to one that transformers knows": "trust_remote_code",
    _ENGINE: "cache_implementation use_transformers_continuous_batching transformers_continuous_batching_config "
    "use_transformers_paged use_cache ds3_gather_for_generation",
    "the loss has no labels": "label_smoothing_factor label_names",
    "micro-batches are packed trees or single rows, and need no multiple": "pad_to_multiple_of",
    "the denominator is counted over all processes in any case": "average_tokens_across_devices",
    "it is decided per row, and an episode may have several; lower `num_iterations`": "off_policy_mask_threshold",
    _ENTROPY: "entropy_coef use_adaptive_entropy entropy_coef_min entropy_coef_max entropy_coef_delta entropy_target",
    _LOSSES: "sapo_temperature_neg sapo_temperature_pos vespo_k_pos vespo_lambda_pos vespo_k_neg vespo_lambda_neg",
    "the packed forward does not return the router's loss": "router_aux_loss_coef",
    "checkpoints do not hold the moving reference, so a resumed run would differ": "sync_ref_model "
    "ref_model_mixup_alpha ref_model_sync_steps",
    "an agent acts through its environment: set `budget` or `max_turns` of the agent": "max_tool_calling_iterations",
    _KERNEL: "use_liger_kernel liger_kernel_config neftune_noise_alpha cast_lm_head_to_fp32",
    "every update has other shapes, and each would be compiled anew": "torch_compile torch_compile_backend "
    "torch_compile_mode",
    "groups must stay whole; set `tokens_per_forward` or a smaller per_device_train_batch_size": "auto_find_batch_size",
    "token counts of episodes are logged as `episode/input_tokens`": "include_num_input_tokens_seen",
    _EPISODES: "log_completions log_multimodal num_completions_to_print log_unique_prompts log_completions_hub_repo",
    _EVALUATION: "per_device_eval_batch_size prediction_loss_only eval_do_concat_batches eval_use_gather_object "
    "eval_accumulation_steps include_for_metrics batch_eval_metrics bf16_full_eval fp16_full_eval",
    _DATA: "data_seed train_sampling_strategy length_column_name",
    "a checkpoint in the middle of an update cannot be resumed exactly; set `save_steps`": "enable_jit_checkpoint",
    "set `resume: true`": "resume_from_checkpoint",
    _SCRIPT: "do_train do_eval do_predict",
    "set `vllm_importance_sampling_clip_max`": "vllm_importance_sampling_cap",
}
"""Why nobody reads it, and what to set instead -> names of the fields."""

ALSO_ALLOWED = {"pad_to_multiple_of": (None,), "do_eval": (True,), "do_train": (True,)}
"""What transformers and TRL themselves write into fields that are refused."""


def defaults(config: type) -> dict[str, Any]:
    """Field of a dataclass -> its default."""
    return {f.name: f.default if f.default_factory is MISSING else f.default_factory() for f in fields(config)}


def field_rules(config: type) -> dict[str, FieldRule]:
    """The rule of every field in the table, by name; `config` is the dataclass with their defaults."""
    default = defaults(config)
    rules = {name: FieldRule("used", heading) for heading, names in USED.items() for name in names.split()}
    rules |= {name: FieldRule("fixed", why, allowed) for name, (why, allowed) in FIXED.items()}
    for why, names in REFUSED.items():
        for name in names.split():
            allowed = (default.get(name), *ALSO_ALLOWED.get(name, ()))
            rules[name] = FieldRule("refused", why, allowed)
    return rules
