"""Calls become the fewest sequences, masks cover exactly what the policy chose."""

from __future__ import annotations

import pytest

from tests.trainers.builders import call, episode
from trainers.sequences import TrainFilter, build_sequences


def test_append_only_calls_share_one_sequence() -> None:
    # Prompt 2 = prompt 1 + completion 1 + [9] written by the environment.
    rows = build_sequences(episode([call(0, [1, 2], [3, 4]), call(1, [1, 2, 3, 4, 9], [5])]))
    assert len(rows) == 1
    assert rows[0].tokens == [1, 2, 3, 4, 9, 5]
    assert rows[0].mask == [0, 0, 1, 1, 0, 1]
    assert rows[0].calls == [-1, -1, 0, 0, -1, 1]
    assert rows[0].logprobs == [0, 0, -1, -1, 0, -1]


def test_rewritten_prompt_starts_a_new_sequence() -> None:
    rows = build_sequences(episode([call(0, [1, 2], [3]), call(1, [1, 7], [3])]))
    assert [r.tokens for r in rows] == [[1, 2, 3], [1, 7, 3]]


def test_a_call_may_return_to_an_earlier_sequence() -> None:
    # The second call branches off, the third extends the first again: two rows, not three.
    rows = build_sequences(episode([call(0, [1], [2]), call(1, [8], [9]), call(2, [1, 2, 5], [6])]))
    assert [r.tokens for r in rows] == [[1, 2, 5, 6], [8, 9]]


def test_untrained_calls_are_context() -> None:
    think = call(0, [1], [2], purpose="think")
    act = call(1, [1, 2, 4], [5])
    rows = build_sequences(episode([think, act]), TrainFilter(("reasoning.*/act",)))
    assert rows[0].tokens == [1, 2, 4, 5] and rows[0].mask == [0, 0, 0, 1]


def test_only_credited_completions_are_trained() -> None:
    calls = [call(0, [1], [2], credit="explored"), call(1, [1], [3]), call(2, [4], [5], module="memory.x")]
    assert [r.tokens for r in build_sequences(episode(calls))] == [[1, 3]]
    both = build_sequences(episode(calls), TrainFilter(("reasoning.*",), ("executed", "explored")))
    # Two completions of one prompt never share a row.
    assert [r.tokens for r in both] == [[1, 2], [1, 3]]


def test_forced_tokens_are_context_and_constraints_are_kept() -> None:
    # Token 5 was one of (5, 6); token 7 was forced; the end 2 was forced.
    c = call(0, [1], [5, 7, 2], logprobs=[-0.7, 0.0, 0.0], allowed=((5, 6), (7,), (2,)))
    row = build_sequences(episode([c]))[0]
    assert row.mask == [0, 1, 0, 0]
    assert row.allowed == {1: (5, 6)}
    assert row.trained == 1


def test_an_episode_with_forced_tokens_only_has_no_rows() -> None:
    c = call(0, [1], [7, 2], logprobs=[0.0, 0.0], allowed=((7,), (2,)))
    assert build_sequences(episode([c])) == []


def test_missing_logprobs_are_refused() -> None:
    from dataclasses import replace

    c = call(0, [1], [2])
    c = replace(c, completions=(replace(c.completions[0], logprobs=()),))
    with pytest.raises(ValueError, match="log-probabilities"):
        build_sequences(episode([c]))
