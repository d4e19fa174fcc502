"""Expert episodes -> a supervised warm start, in the scaffolds that the policy will meet.

Few tokens of a row are the expert's: a dozen short actions among thousands of tokens of prompts and observations. So
TRL's `SFTTrainer` gets its loss from the packed forward, which computes logits only where a token is trained.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn
from trl import SFTTrainer

from agentspec.demonstration import play_expert
from agentspec.spec import AgentSpec
from agentspec.trajectory import Trajectory
from agentspec.types import Task
from trainers.forward import rows_logprobs
from trainers.sequences import Row, TokenSequence, TrainFilter, build_sequences
from trainers.tree.model import enable_tree


def demonstrate(
    specs: Sequence[AgentSpec], tokenizer: Any, tasks: Sequence[Task], train: TrainFilter, seed: int = 0
) -> tuple[list[dict[str, list[int]]], list[Trajectory]]:
    """Rows of token ids and which of them the expert wrote (1), and its episodes inside the scaffolds `specs`.

    Of every `len(specs)` tasks in a row each scaffold plays one, drawn by `seed`: none gets the same level each time.

    Raises:
        SpecError: an episode failed, or a scaffold asks what the expert cannot answer.
    """
    rng, shares = random.Random(seed), [list[Task]() for _ in specs]
    for start in range(0, len(tasks), len(specs)):
        places = rng.sample(range(len(specs)), len(specs))
        for place, task in zip(places, tasks[start : start + len(specs)], strict=False):
            shares[place].append(task)
    episodes = [e for spec, share in zip(specs, shares, strict=True) for e in play_expert(spec, tokenizer, share)]
    sequences = (s for episode in episodes for s in build_sequences(episode, train))
    rows = [{"input_ids": s.tokens, "assistant_masks": [int(c >= 0) for c in s.calls]} for s in sequences]
    return rows, episodes


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
