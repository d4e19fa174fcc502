"""Several processes: which parallel layouts work, and what ranks refuse together.

DDP and DeepSpeed ZeRO 1 and 2 keep whole weights on every rank, so a rank may read them, and run as many forwards as
its rows need, without asking the others. FSDP and ZeRO-3 shard them: every forward gathers weights from all ranks, so
nobody may read them between forwards, and all ranks must run the same number of forwards. What breaks that would not
fail but wait for ever, and is refused at start.
"""

from __future__ import annotations

import atexit
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from trl.distributed import DistributedBackend

from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory
from agentspec.types import LLMCall
from trainers.config import ScaffoldConfig
from trainers.sequences import TrainFilter, trained_completions


def check_layout(accelerator: Any, config: ScaffoldConfig) -> None:
    """Refuse (`SpecError`) a parallel layout that this configuration would hang in."""
    layout = DistributedBackend(accelerator)
    if not layout.is_fsdp and not layout.is_zero3:
        return
    if layout.is_fsdp and layout.fsdp_version != 2:
        raise SpecError(
            f"FSDP version {layout.fsdp_version}: only version 2 is known to give the gradients of one process; set "
            "fsdp_version: 2 (recipes/accelerate/fsdp.yaml)"
        )
    name = "FSDP" if layout.is_fsdp else "DeepSpeed ZeRO-3"
    if not config.use_vllm:
        raise SpecError(
            f"{name} keeps a part of the weights on each process, and the local backend samples from whole ones: set "
            "use_vllm: true, or launch with DDP (recipes/accelerate/ddp.yaml), which LoRA rarely outgrows"
        )
    if config.packing != "tree" or config.tokens_per_forward:
        raise SpecError(
            f"packing {config.packing!r} with tokens_per_forward {config.tokens_per_forward} under {name}: the number "
            "of forwards would differ between processes, and they would wait for each other for ever; set packing: "
            "tree and tokens_per_forward: 0 (a smaller per_device_train_batch_size bounds memory)"
        )


def is_sharded(accelerator: Any) -> bool:
    """Whether weights are sharded over processes (FSDP, ZeRO-3)."""
    layout = DistributedBackend(accelerator)
    return bool(layout.is_fsdp or layout.is_zero3)


def keep_precision(accelerator: Any) -> None:
    """Let FSDP compute in its low precision, but not round what goes into a forward and comes out of it.

    accelerate asks for both; temperatures and log-probabilities would have three digits.
    """
    plugin = getattr(accelerator.state, "fsdp_plugin", None)
    policy = getattr(plugin, "mixed_precision_policy", None)
    if plugin is not None and policy is not None:
        plugin.mixed_precision_policy = replace(policy, output_dtype=None, cast_forward_inputs=False)


def check_trained(episodes: Sequence[Trajectory], train: TrainFilter, gather: Callable[[list[Any]], list[Any]]) -> None:
    """Refuse a generation batch of which no call is trained, or one that was not sampled to be: on all ranks together.

    A rank that raised alone would leave the others waiting for it.

    Args:
        gather: list of this rank -> concatenated lists of all ranks.

    Raises:
        SpecError: there are episodes to learn from, and none made such a call; or a trained call was greedy, or sampled
            from a part of the distribution, which the update would not recompute.
    """
    scored = [t for t in episodes if t.scorable]
    calls = [call for t in scored for call, _ in trained_completions(t, train)]
    called = {f"{c.tag.path} ({p.credit})" for t in episodes for c in t.calls for p in c.completions}
    ranks = gather([(bool(scored), bool(calls), called, {*filter(None, map(_unusable, calls))})])
    unusable = set().union(*(bad for *_, bad in ranks))
    if unusable:
        raise SpecError(
            f"trained calls were sampled with {', '.join(sorted(unusable))}; the update recomputes log-probabilities "
            "of the whole distribution at a temperature above 0: set temperature above 0, top_p 1 and top_k 0, or "
            "leave these calls out of train_calls"
        )
    if any(trained for _, trained, *_ in ranks) or not any(has for has, *_ in ranks):
        return
    raise SpecError(
        f"no call of this generation batch matched train_calls {list(train.patterns)} with credits "
        f"{list(train.credits)}; the scaffold called {sorted(set().union(*(called for _, _, called, _ in ranks)))}"
    )


def _unusable(call: LLMCall) -> str:
    """What of a trained call's sampling has no exact gradient; empty if all of it has."""
    sampling = call.sampling
    if sampling.temperature <= 0:
        return f"temperature {sampling.temperature} ({call.tag.path})"
    if sampling.top_p < 1 or sampling.top_k > 0:
        return f"top_p {sampling.top_p} and top_k {sampling.top_k} ({call.tag.path})"
    return ""


def end_process() -> None:
    """Where this process is in a group: leave it and end the process with exit code 0. The last thing a script does.

    Nothing after the call happens then; a process without a group goes on.

    A thread of the group that lets go of a Python object while the interpreter is taken apart aborts the process
    ("terminate called without an active exception"), and the launcher calls that a failure. So what is registered to
    run at the end runs, what was printed is written, and the interpreter is left as it is.
    """
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
