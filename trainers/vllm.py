"""Rounds with vLLM: the policy's weights go in before it samples, and what its kernels do otherwise is corrected.

TRL's `VLLMGeneration` owns the engine: it merges the adapter, gathers what is sharded and pushes the weights. It also
puts the engine to sleep between its own calls of `generate`; a scaffold asks many times a round, so here a whole
round is one stretch awake. The engine itself is spoken to by `agentspec.llm.vllm`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from agentspec.registry import SpecError

if TYPE_CHECKING:
    from trainers.config import ScaffoldConfig

BATCH_INVARIANT = "VLLM_BATCH_INVARIANT"
"""The environment variable that asks vLLM for its batch-invariant mode."""
_LEAST_CAPABILITY = (8, 0)


def prepare_vllm(config: ScaffoldConfig) -> None:
    """Make the engine that is about to be built batch-invariant, if `vllm_batch_invariant` asks for it.

    vLLM's mode replaces its matrix products, reductions and choice of attention by such that treat a request alike in
    every batch (its page "Batch Invariance"; NVIDIA GPUs of compute capability 8.0 and above).

    Raises:
        SpecError: this process's device does not have it, or vLLM does not take it from here.
    """
    if not config.vllm_batch_invariant:
        return
    if not torch.cuda.is_available() or torch.cuda.get_device_capability() < _LEAST_CAPABILITY:
        found = torch.cuda.get_device_name() if torch.cuda.is_available() else "no CUDA device"
        raise SpecError(
            f"vllm_batch_invariant needs an NVIDIA GPU of compute capability 8.0 or above; found {found}; leave it out"
        )
    if os.environ.get(BATCH_INVARIANT) != "1":
        os.environ[BATCH_INVARIANT] = "1"
        # TRL has imported vLLM by now: releases that read the variable on import would not see it.
        if not getattr(importlib.import_module("vllm.envs"), BATCH_INVARIANT, False):
            raise SpecError(
                "vllm_batch_invariant came too late: this release of vLLM reads it when it is imported; set "
                f"{BATCH_INVARIANT}=1 in the environment of the whole process"
            )


@contextmanager
def vllm_round(generation: Any, *, stale: bool) -> Iterator[None]:
    """The engine holds the policy's weights and is awake inside this block.

    Args:
        generation: TRL's `VLLMGeneration`.
        stale: whether the weights changed since they were pushed last. Every rank must say the same: gathering sharded
            weights takes all of them.
    """
    sleeps = generation.mode == "colocate" and generation.enable_sleep_mode
    # Sleep of level 2 throws the weights away: they are pushed again even if they did not change.
    if stale or (sleeps and generation._llm_weights_sleeping):
        with base_kept(generation.model):
            generation.sync_weights()
    if sleeps:
        generation.llm.wake_up(tags=["kv_cache"])
    try:
        yield
    finally:
        if sleeps:
            generation.llm.sleep(level=2)
            generation._llm_weights_sleeping = True


@contextmanager
def base_kept(model: nn.Module) -> Iterator[None]:
    """Weights under an adapter are bit for bit what they were after this block.

    To push an adapter, it is added to the base weights and subtracted again. In bfloat16 that rounds, update after
    update, and neither the saved adapter nor its base would know. The copy waits in main memory.
    """
    # ZeRO-3 (its parameters have a `ds_id`) merges into gathered copies and throws them away.
    frozen = [p for n, p in model.named_parameters() if ".base_layer." in n and not hasattr(p, "ds_id")]
    kept = [_local(p).to("cpu", copy=True) for p in frozen]
    try:
        yield
    finally:
        for parameter, copy in zip(frozen, kept, strict=True):
            _local(parameter).copy_(copy)


def _local(parameter: torch.Tensor) -> torch.Tensor:
    """This rank's shard of a parameter, sharing its memory (all of it where nothing is sharded)."""
    data: Any = parameter.detach()
    local: torch.Tensor = data.to_local() if hasattr(data, "to_local") else data
    return local


def importance_ratio(
    logps: torch.Tensor,
    sampled: torch.Tensor,
    mask: torch.Tensor,
    mode: str = "token_truncate",
    low: float | None = None,
    high: float | None = 3.0,
) -> torch.Tensor:
    """Weight of each token for having been sampled by vLLM's kernels and not by the trainer's.

    `exp(logps - sampled)`, clipped to `low .. high` (`token_truncate`) or 0 outside (`token_mask`); 1 where
    `mask` is 0. Truncated importance sampling, token by token, as TRL's.

    Args:
        logps, sampled, mask: (B, T), as the result: log-probabilities recomputed and recorded; what is trained.
    """
    ratio = ((logps.detach() - sampled) * mask).exp()
    least, most = (0.0 if low is None else low), (torch.inf if high is None else high)
    if mode == "token_truncate":
        return ratio.clamp(least, most)
    return ratio.masked_fill((ratio < least) | (ratio > most), 0.0)
