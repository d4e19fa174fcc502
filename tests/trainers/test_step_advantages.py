"""Exact numbers of step-level credit."""

from __future__ import annotations

import math

import pytest

from trainers.step_advantages import discounted, gigpo, reward_to_go


def close(got: list[list[float]], expected: list[list[float]]) -> bool:
    return all(
        math.isclose(a, b, abs_tol=2e-3) for g, e in zip(got, expected, strict=True) for a, b in zip(g, e, strict=True)
    )


def test_discounted() -> None:
    assert discounted([1.0, 0.0, 2.0], 1.0) == [3.0, 2.0, 2.0]
    assert discounted([], 0.9) == []


def test_reward_to_go_baseline_per_step() -> None:
    # To go: [3, 2], [1, 0] -> means [2, 1] -> centred [1, 1], [-1, -1]; deviation sqrt(4 / 3) = 1.1547.
    assert close(reward_to_go([[1.0, 2.0], [1.0, 0.0]]), [[0.866, 0.866], [-0.866, -0.866]])


def test_an_ended_rollout_earns_nothing_more() -> None:
    # To go: [2], [0, 4] gives [4, 4]; means: step 0 (2 + 4) / 2 = 3, step 1 (0 + 4) / 2 = 2.
    got = reward_to_go([[2.0], [0.0, 4.0]])
    # Centred [-1], [1, 2]: deviation sqrt(6 / 2) = 1.732.
    assert close(got, [[-0.577], [0.577, 1.155]])


def test_unscorable_and_lonely_rollouts() -> None:
    assert reward_to_go([[1.0, 2.0], None, [1.0, 0.0]])[1] == []
    assert close(reward_to_go([[1.0, 2.0], None, [1.0, 0.0]])[::2], reward_to_go([[1.0, 2.0], [1.0, 0.0]]))
    assert reward_to_go([[1.0, 2.0], None]) == [[0.0, 0.0], []]
    assert reward_to_go([[1.0], [1.0]]) == [[0.0], [0.0]]


def test_gigpo_compares_actions_taken_in_the_same_state() -> None:
    # Both start in "a"; one goes on to "b", one to "c". Totals 2 and 0: episode advantages +-1 / 1.4142 = +-.707.
    # Step group "a": to go 2 and 0: +-.707 again. "b" and "c" were met once: 0.
    got = gigpo([[0.0, 2.0], [0.0, 0.0]], [["a", "b"], ["a", "c"]])
    assert close(got, [[1.414, 0.707], [-1.414, -0.707]])
    without = gigpo([[0.0, 2.0], [0.0, 0.0]], [["a", "b"], ["a", "c"]], weight=0.0)
    assert close(without, [[0.707, 0.707], [-0.707, -0.707]])


def test_gigpo_checks_its_anchors() -> None:
    with pytest.raises(ValueError, match="2 steps and 1 anchor"):
        gigpo([[0.0, 1.0], None], [["a"], []])
