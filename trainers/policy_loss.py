"""The loss of one micro-batch: log-probabilities of its rows, and the objective that the configuration names.

Mixed into the trainer. TRL computes TRL's losses, from log-probabilities that are given to it here; an objective of
`trainers.losses` is computed beside it, with TRL's divergence, importance ratio and figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn
from trl.trainer.utils import use_adapter

from trainers.distributed import is_sharded
from trainers.finite import require_finite
from trainers.forward import rows_logprobs
from trainers.losses import divergence
from trainers.micro_batches import PADDED, ROWS
from trainers.mixin import Base
from trainers.sequences import Row
from trainers.vllm import importance_ratio


class PolicyLoss(Base):
    """Computes the loss of a micro-batch as of `trainers.micro_batches.collate`; see the module's docstring."""

    _current: dict[str, Any] | None = None

    @property
    def _steps_per_round(self) -> int:
        """Micro-batches between two generation rounds."""
        return int(self.args.steps_per_generation * self.num_iterations)

    @property
    def _off_policy(self) -> bool:
        """Whether an update may see weights other than those that sampled (then the recorded log-probs are the old)."""
        return bool(self.args.gradient_accumulation_steps % self._steps_per_round != 0)

    @property
    def _skip_backward(self) -> bool:
        """Whether rows with advantage 0 have no gradient, and can be computed without a backward pass.

        A divergence from the reference gives them one. Where weights are sharded every rank must run as many forwards
        as the others.
        """
        return self.beta == 0.0 and not is_sharded(self.accelerator)

    def _reference_logprobs(self, rows: Sequence[Row]) -> torch.Tensor:
        """Log-probabilities under the reference: the policy as training began, or the base under its adapter."""
        with torch.no_grad():
            if self.ref_model is not None:
                return rows_logprobs(self.ref_model, rows, **self._packing)[0]
            model = self.accelerator.unwrap_model(self.model)
            initial = self.args.reference == "initial" and "ref" in model.peft_config  # TRL's copy of the adapter
            with use_adapter(model, adapter_name="ref" if initial else None):
                return rows_logprobs(model, rows, frozen=self._below, **self._packing)[0]

    def _compute_loss(self, model: nn.Module, inputs: dict[str, Any]) -> torch.Tensor:
        self._current = inputs
        try:
            compute = self._own_loss if self.loss_spec.objective else super()._compute_loss
            value: torch.Tensor = compute(model, inputs)
            if self.loss_spec.row_mean:  # TRL's mean counts padding rows, whose share depends on the partition
                value = value * inputs[PADDED]
        finally:
            self._current = None
        require_finite("loss", [(self.args.loss_type, value.detach())], self.state.global_step)
        return value

    def _own_loss(self, model: nn.Module, inputs: dict[str, Any]) -> torch.Tensor:
        """As TRL computes its losses, with an objective of `trainers.losses`."""
        logps, entropies, _ = self._get_per_token_logps_and_entropies(model)
        mask, old = inputs["tool_mask"], inputs.get("old_per_token_logps", logps.detach())
        per_token = self.loss_spec.objective(logps, old, per_token_advantages(inputs), **self._limits)
        clipped = self.loss_spec.clipped(logps.detach(), old, per_token_advantages(inputs), **self._limits)
        figures = {"entropy": entropies, "clip_ratio/region_mean": clipped.float()}
        if self.top_entropy_quantile < 1.0:
            per_token = per_token * self.get_high_entropy_mask(entropies, mask, 1 - self.top_entropy_quantile)
        per_token = per_token * inputs.get("importance_sampling_ratio", 1.0)
        if self.beta != 0.0:
            figures["kl"] = divergence(logps, inputs["ref_per_token_logps"])
            if self.args.use_bias_correction_kl:
                figures["kl"] = figures["kl"] * (logps - old).exp()
            per_token = per_token + self.beta * figures["kl"]
        for name, values in figures.items():
            sums = torch.stack([(values.detach() * mask).sum(), mask.sum().float()])
            total, count = self.accelerator.reduce(sums, reduction="sum")
            self._metrics["train"][name].append((total / count.clamp(min=1.0)).item())
        # The denominator spans the round; an update is one accumulation window of it, and processes are averaged.
        share = self.current_gradient_accumulation_steps / self.args.steps_per_generation
        denominator = inputs["num_items_in_batch"].clamp(min=1) * share / self.accelerator.num_processes
        return (per_token * mask).sum() / denominator

    @property
    def _limits(self) -> dict[str, float]:
        return {"low": self.epsilon_low, "high": self.epsilon_high}

    def _get_per_token_logps_and_entropies(self, model: nn.Module, *_: Any, **__: Any) -> Any:
        """Log-probabilities of the micro-batch's rows under the distributions they were sampled from."""
        inputs = self._current
        assert inputs is not None, "log-probabilities are computed inside a loss"
        with self.accelerator.autocast():
            logps, entropies = rows_logprobs(
                model, inputs[ROWS], skip_backward=self._skip_backward, frozen=self._below, **self._packing
            )
        trained, current = inputs["tool_mask"], logps.detach()
        if self._step % self._steps_per_round < self.args.gradient_accumulation_steps:  # still those that sampled
            self._sampling_metrics.differences.append((current - inputs["sampled_logprobs"]).abs()[trained > 0])
        old = inputs.get("old_per_token_logps", current)
        clipped = self.loss_spec.clipped(current, old, per_token_advantages(inputs), **self._limits)
        self._call_metrics.add(inputs[ROWS], entropies, clipped)
        if self.use_vllm and self.vllm_importance_sampling_correction:
            # Where the recorded log-probabilities are the old ones, the ratio starts from what vLLM sampled already.
            bounds = self.vllm_importance_sampling_clip_min, self.vllm_importance_sampling_clip_max
            inputs["importance_sampling_ratio"] = importance_ratio(
                old, inputs["sampled_logprobs"], trained, self.vllm_importance_sampling_mode, *bounds
            )
            self._sampling_metrics.ratios.append(inputs["importance_sampling_ratio"][trained > 0])
        return logps, entropies, None


def per_token_advantages(inputs: dict[str, Any]) -> torch.Tensor:
    """(B, 1), or (B, T) of an estimator per step."""
    advantages: torch.Tensor = inputs["advantages"]
    return advantages.unsqueeze(1) if advantages.dim() == 1 else advantages
