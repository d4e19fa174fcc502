"""Sixteen ways in which implementations of multi-sequence RL went wrong, and the test that each is none of ours.

:data:`COVERED` names at least one test per pitfall; those that are tested nowhere else are below.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("trl")


from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from agentspec.types import Completion
from rewards import RewardSet
from tests.trainers.builders import call, episode
from tests.trainers.played import toy_tasks, toy_trainer
from tests.trainers.test_supo import configured, credited, played
from trainers.checks import notes
from trainers.losses import LOSSES
from trainers.micro_batches import collate, padding_row, partition
from trainers.sequences import Row, TokenSequence

COVERED = {
    "1 normalising over rows": ["test_credit.py::test_rows_per_episode_do_not_move_the_baseline"],
    "2 the last row as representative": ["test_pitfalls.py::test_an_untrained_last_segment_silences_nothing"],
    "3 broadcast by position": ["test_pitfalls.py::test_every_row_keeps_its_own_advantage_in_any_partition"],
    "4 wrong group key": ["test_pitfalls.py::test_a_group_is_one_task_played_by_all_its_rollouts"],
    "5 mean over an empty mask": [
        "test_pitfalls.py::test_nothing_to_learn_is_no_nan",
        "test_isolation.py::test_a_round_in_which_everything_fails_changes_nothing",
    ],
    "6 sequence-mean losses": [
        "test_pitfalls.py::test_losses_that_weigh_rows_are_named_or_refused",
        "test_grpo.py::test_uneven_rows_give_the_full_batch_gradient_in_one_step",
    ],
    "7 remainder rows dropped": ["test_pitfalls.py::test_every_row_keeps_its_own_advantage_in_any_partition"],
    "8 dummy rows in the denominator": ["test_pitfalls.py::test_the_denominator_counts_what_is_trained"],
    "9 acted, but the result is never seen": ["test_summary.py::test_every_eight_actions_a_summary_replaces"],
    "10 context not really switched": ["test_summary.py::test_every_eight_actions_a_summary_replaces"],
    "11 truncated summaries": ["test_supo.py::test_truncated_summaries_are_counted_and_masked"],
    "12 summaries encoded again": ["test_supo.py::test_a_summary_in_the_next_prompt_is_context"],
    "13 only the last segment reported": ["test_pitfalls.py::test_metrics_are_of_the_whole_episode"],
    "14 overlong rollouts in the baseline": ["test_supo.py::test_overlong_episodes"],
    "15 early stops are not overlong": ["test_supo.py::test_which_ends_are_overlong"],
    "16 equal up to float noise": ["test_estimators.py::test_groups_without_signal_get_exactly_zero"],
}


@pytest.mark.parametrize("pitfall", COVERED)
def test_every_pitfall_has_a_test(pitfall: str) -> None:
    here = Path(__file__).parent
    for place in COVERED[pitfall]:
        name, _, function = place.partition("::")
        file = here / name if (here / name).is_file() else here.parent / name
        assert re.search(rf"^def {function}", file.read_text(encoding="utf-8"), re.MULTILINE), place


def test_an_untrained_last_segment_silences_nothing(tmp_path: Path) -> None:
    # verl: an all-zero mask of the last segment makes the whole episode's advantage 0.
    def rollout(value: float, i: int) -> Any:
        last = call(1, [7, i], [8, 9], module="memory.summary", purpose="summary")
        cut = Completion("x", (8, 9), (-1.0, -1.0), (), "length", "executed")
        calls = [call(0, [1, i], [2, 3]), last.__class__(last.id, last.tag, last.prompt_ids, (cut,), last.sampling)]
        return episode(calls, [value], rollout=i)

    settings = {"train_calls": ["reasoning.*", "memory.summary"], "mask_truncated": ["memory.summary"]}
    config = configured(tmp_path, num_generations=2, **settings)
    result = credited([rollout(1.0, 0), rollout(0.0, 1)], config)
    # Deviation of (1, 0) is .7071: .5 / (.7071 + 1e-4) = .707.
    assert [(r.episode, round(r.advantage, 3)) for r in result.rows] == [(0, 0.707), (1, -0.707)]  # type: ignore[arg-type]


def _row(number: int, length: int) -> Row:
    sequence = TokenSequence()
    sequence.extend_context([number % 97, number // 97, *[3] * length])
    sequence.mask[-1] = 1
    return Row(sequence, float(number + 1), number)


@given(st.lists(st.integers(1, 6), max_size=20), st.integers(1, 5), st.integers(0, 3), st.booleans())
def test_every_row_keeps_its_own_advantage_in_any_partition(
    lengths: list[int], count: int, room: int, by_prefix: bool
) -> None:
    rows = [_row(i, n) for i, n in enumerate(lengths)]
    size = -(-max(1, len(rows)) // count) + room
    parts = partition(rows, count, padding=padding_row(0), size=size, by_prefix=by_prefix)
    # The number of micro-batches is fixed, all are of one size, and no row is lost or doubled.
    assert [len(part) for part in parts] == [size] * count
    assert sorted(r.episode for part in parts for r in part if r.episode >= 0) == list(range(len(rows)))
    # As many rows in each, short of one: none is empty while there are rows enough.
    filled = [sum(r.episode >= 0 for r in part) for part in parts]
    assert max(filled) - min(filled) <= 1 or not by_prefix
    assert min(filled) >= min(1, len(rows) // count)
    for part in parts:
        batch = collate(part, 0)
        for i, row in enumerate(part):
            number = row.episode
            assert batch["advantages"][i] == (number + 1 if number >= 0 else 0)
            if number >= 0:
                assert (batch["prompt_ids"][i, 0], batch["completion_ids"][i, 0]) == (number % 97, number // 97)
            assert batch["tool_mask"][i].sum() == (1 if number >= 0 else 0)


def test_a_group_is_one_task_played_by_all_its_rollouts(tmp_path: Path) -> None:
    trainer = toy_trainer(tmp_path, toy_tasks(4), num_generations=2, per_device_train_batch_size=4, max_steps=1)
    trainer.train()
    episodes = trainer.last_episodes
    assert len(episodes) == 8
    for start in range(0, 8, 2):
        group = episodes[start : start + 2]
        assert len({t.task.key for t in group}) == 1 and [t.rollout for t in group] == [0, 1]
        assert len({t.seed for t in group}) == 2  # different draws
    assert len({t.task.key for t in episodes}) == 4


def test_nothing_to_learn_is_no_nan(tmp_path: Path) -> None:
    nobody = [episode([call(0, [1], [2])], [1.0], status="failed", rollout=i) for i in range(4)]
    result = credited(nobody, configured(tmp_path))
    assert result.rows == []
    assert all(torch.tensor(v).isfinite() for v in result.metrics.values())
    silent = [episode([], [1.0], rollout=i) for i in range(4)]
    assert credited(silent, configured(tmp_path)).rows == []


def test_losses_that_weigh_rows_are_named_or_refused(tmp_path: Path) -> None:
    for loss_type, spec in LOSSES.items():
        told = [n for n in notes(configured(tmp_path, loss_type=loss_type)) if "depend on rows" in n]
        assert [loss_type in note and "'dapo' does not depend on rows" in note for note in told] == (
            [True] if spec.depends_on_rows else []
        )
    # GSPO's ratio is of a row, not of a rollout.
    with pytest.raises(SpecError, match="speaks of rows"):
        configured(tmp_path, importance_sampling_level="sequence").check()


def test_the_denominator_counts_what_is_trained(tmp_path: Path) -> None:
    """Rows of padding have no trained token; rows without gradient count unless their groups are skipped by choice."""
    values = [1.0, 1.0, 0.0, 1.0]  # the first group has no variance
    episodes = [episode([call(0, [1, i], [2] * (i + 1))], [v], rollout=i % 2) for i, v in enumerate(values)]
    kept = credited(episodes, configured(tmp_path, num_generations=2))
    skipped = credited(episodes, configured(tmp_path, num_generations=2, skip_zero_variance=True))
    assert kept.metrics["rollouts/trained_tokens"] == 1 + 2 + 3 + 4
    assert skipped.metrics["rollouts/trained_tokens"] == 3 + 4
    assert kept.metrics["groups/zero_variance"] == skipped.metrics["groups/zero_variance"] == 0.5
    assert padding_row(0).sequence.trained == 0 and padding_row(0).zero_gradient


def test_the_logged_denominator_is_that_of_the_loss(tmp_path: Path) -> None:
    agent = {"reasoning": "direct", "memory": {"name": "summary", "every": 2, "summary_tokens": 4}}
    # Three actions, a summary (not trained here) after the second: two rows per episode.
    toy_trainer(tmp_path, agent=agent | {"sampling": {"max_tokens": 8}}, max_steps=1).train()
    (record,) = RunLog(tmp_path).read("updates.jsonl")
    assert record["denominator"] == sum(r["trained"] for r in record["rows"])


def test_metrics_are_of_the_whole_episode() -> None:
    # Seven steps in three segments: the return is the sum over all of them.
    (seller, waiter) = played(steps=7)
    assert seller.metrics["steps"] == waiter.metrics["steps"] == 7
    assert seller.metrics["return"] == sum(t.reward for t in seller.transitions) == RewardSet().score(seller).total
    assert seller.metrics["return"] > max(t.reward for t in seller.transitions[-1:]) and waiter.metrics["return"] == 0
    assert seller.metrics["llm_calls"] == 7 + 2
