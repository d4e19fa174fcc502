"""Expert episodes -> a supervised warm start, in the layout that the policy will meet.

Few tokens of a row are the expert's: a dozen short actions among thousands of tokens of prompts and observations. So
TRL's `SFTTrainer` gets its loss from the packed forward, which computes logits only where a token is trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn
from trl import SFTTrainer

from agentspec.episode import Job, MakeEnv, Runner, make_env
from agentspec.llm.demonstration import DemonstrationLLM
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec, ModuleSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from trainers.forward import rows_logprobs
from trainers.sequences import Row, TokenSequence, TrainFilter, build_sequences
from trainers.tree.model import enable_tree


@dataclass(frozen=True)
class Demonstrations:
    """Rows of token ids and which of them the expert wrote (1), and the episodes they come from."""

    rows: list[dict[str, list[int]]]
    episodes: list[Trajectory]


def demonstrate(
    spec: AgentSpec,
    tokenizer: Any,
    tasks: Sequence[Task],
    *,
    expert: str = "rule_based",
    make_env: MakeEnv = make_env,
) -> Demonstrations:
    """Play `tasks` with the expert, then again inside `spec` with the expert's actions as answers.

    The second pass writes the prompts of the scaffold; the environment is deterministic, so both passes agree.

    Raises:
        SpecError: an episode failed, or the scaffold does not make one acting call per step.
    """
    jobs = [Job(task) for task in tasks]
    scripted = replace(spec, reasoning=ModuleSpec(expert), memory=ModuleSpec("none"), reflection=ModuleSpec("none"))
    played = Runner(scripted, make_env=make_env).run(jobs)
    actions = {episode.episode: [t.action_text for t in episode.transitions] for episode in played}
    episodes = Runner(spec, DemonstrationLLM(tokenizer, actions), make_env=make_env).run(jobs)
    failed = [t.error for t in (*played, *episodes) if not t.scorable]
    if failed:
        raise SpecError(f"{len(failed)} of {2 * len(jobs)} demonstration episodes failed, the first with: {failed[0]}")
    rows = [
        {"input_ids": s.tokens, "assistant_masks": [int(c >= 0) for c in s.calls]}
        for episode in episodes
        for s in build_sequences(episode, TrainFilter())
    ]
    return Demonstrations(rows, episodes)


class DemonstrationTrainer(SFTTrainer):
    """`SFTTrainer` whose forward is packed; the loss is the same mean negative log-likelihood of labelled tokens."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        enable_tree(self.accelerator.unwrap_model(self.model))

    def compute_loss(
        self,
        model: nn.Module,
        inputs: dict[str, torch.Tensor],
        return_outputs: bool = False,
        num_items_in_batch: torch.Tensor | int | None = None,
    ) -> torch.Tensor:
        """Mean over the labelled tokens of the (accumulated) batch."""
        rows = [Row(_labelled(ids, labels), 1.0, i) for i, (ids, labels) in enumerate(_pairs(inputs))]
        logps, _ = rows_logprobs(model, rows, packing="tree")
        count = num_items_in_batch if num_items_in_batch is not None else sum(r.sequence.trained for r in rows)
        return -logps.sum() / count


def _pairs(inputs: dict[str, torch.Tensor]) -> list[tuple[list[int], list[int]]]:
    """Ids and labels of each row, padding removed."""
    rows = zip(inputs["input_ids"], inputs["labels"], inputs["attention_mask"], strict=True)
    return [(ids[m.bool()].tolist(), labels[m.bool()].tolist()) for ids, labels, m in rows]


def _labelled(ids: list[int], labels: list[int]) -> TokenSequence:
    sequence = TokenSequence()
    sequence.extend_context(ids)
    sequence.mask = [0] + [int(label >= 0) for label in labels[1:]]
    return sequence
