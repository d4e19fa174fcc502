"""One episode as a conversation, as every adapter plays it."""

from __future__ import annotations

import pytest

from agentspec.interop.game import OVER, Game

pytest.importorskip("minigrid")

SOLUTION = ("go forward", "go forward", "turn right", "go forward", "go forward")


def test_what_the_last_step_earned_is_paid_once():
    """A client that sums `reward` per act and goes on after the end earns no more than the episode paid."""
    game = Game("minigrid", {"level": "MiniGrid-Empty-5x5-v0", "action_mode": "menu"})
    game.start(0)
    rewards = []
    for text in (*SOLUTION, "done", "go forward"):
        said = game.act(text)
        rewards.append(game.reward)
    assert said == OVER and game.over
    assert rewards[:4] == [0.0] * 4 and rewards[4] > 0.9 and rewards[5:] == [0.0, 0.0]
    assert game.total == rewards[4] and game.steps == 5
