"""Rewards that read declarations work in every environment that declares, and say so where it does not."""

from __future__ import annotations

from typing import Any

import gymnasium
import pytest

from agentspec.metrics import Metric
from rewards import RewardSet
from tests.toy_env import TOY, ToyEnv
from tests.trainers.builders import episode


class Race(ToyEnv):
    metadata = {"render_modes": [], "metrics": (Metric("laps", higher_is_better=False),)}  # noqa: RUF012


RACE = "agentspec-test/Race-v0"
if RACE not in gymnasium.registry:
    gymnasium.register(RACE, entry_point=Race)


def paid(name: str, env: str, **metrics: Any) -> Any:
    from dataclasses import replace

    played = episode([], rewards=[1.0, 2.0, 3.0])
    return (
        RewardSet({name: 1.0}).score(replace(played, task=replace(played.task, env=env), metrics=metrics)).terms[name]
    )


def test_success_is_paid_once_at_the_end() -> None:
    assert paid("success", TOY, success=True) == (0.0, 0.0, 1.0)
    assert paid("success", TOY, success=False) == (0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match=r"needs metrics\['success'\]"):
        paid("success", TOY)


def test_the_outcome_is_the_primary_figure() -> None:
    assert paid("outcome", TOY, net_earnings=7.5, deliveries=2) == (0.0, 0.0, 7.5)
    assert paid("outcome", "deliverybench", hourly_profit=-4.0, net_earnings=9.0) == (0.0, 0.0, -4.0)
    assert paid("outcome", RACE, laps=12) == (0.0, 0.0, -12.0)  # fewer are better
    with pytest.raises(ValueError, match="CartPole-v1 declares no metrics"):
        paid("outcome", "CartPole-v1")
    with pytest.raises(ValueError, match="does not report its net_earnings"):
        paid("outcome", TOY)
