"""Credit of whole rollouts: who counts in a baseline, who has rows, and what each token earns. Exact numbers."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory
from tests.trainers.builders import call, episode
from trainers.config import ScaffoldConfig
from trainers.credit import FIELDS, Credited, CreditRule, Outcome
from trainers.sequences import TrainFilter
from trainers.writes import WriteRule


def credited(episodes: list[Trajectory], **rule: Any) -> Credited:
    whole = CreditRule(**{"group": 2, **rule})
    return whole.credit(whole.score(episodes))


def config(tmp_path: Path, **changes: Any) -> ScaffoldConfig:
    return ScaffoldConfig(output_dir=str(tmp_path), use_cpu=True, bf16=False, num_generations=2, **changes)


def test_one_rule_from_a_configuration_and_from_its_record(tmp_path: Path) -> None:
    given = config(
        tmp_path,
        estimator="gigpo",
        gamma=0.9,
        gigpo_weight=0.5,
        normalize="rollout",
        overlong="drop",
        overlong_ends=["budget"],
        skip_zero_variance=True,
        train_calls=["memory.*"],
        train_credits=["aux"],
        mask_truncated=["memory.summary"],
        rewards={"env": 2.0},
        write_credit="local",
        write_calls=["memory.summary"],
        write_rerolls=3,
        write_points=2,
    )
    rule = given.credit_rule
    assert rule == CreditRule.from_manifest(given.to_dict())
    assert rule == CreditRule(
        2,
        "gigpo",
        0.9,
        0.5,
        "rollout",
        "drop",
        ("budget",),
        True,
        TrainFilter(("memory.*",), ("aux",), ("memory.summary",)),
        {"env": 2.0},
        WriteRule("local", ("memory.summary",), 3, 2),
    )
    # Every value above differs from the default, so no field can be forgotten on the way.
    plain = config(tmp_path).credit_rule
    assert all(getattr(plain, f.name) != getattr(rule, f.name) for f in fields(CreditRule) if f.name != "group")
    assert all(getattr(plain.writes, f.name) != getattr(rule.writes, f.name) for f in fields(WriteRule))
    with pytest.raises(ValueError, match="lacks normalize"):
        CreditRule.from_manifest({n: v for n, v in given.to_dict().items() if n in FIELDS and n != "normalize"})


def test_a_rollout_that_cannot_be_scored_counts_nowhere() -> None:
    rule = CreditRule(group=4)
    outcomes = [Outcome((1.0,)), Outcome(None), Outcome((0.0,)), Outcome((0.5,))]
    # 1, 0, .5: mean .5, sample deviation .5 + 1e-4: +-.5 / .5001.
    first, none, second, third = rule.advantages(outcomes)
    assert none is None and (first, second, third) == (0.5 / 0.5001, -0.5 / 0.5001, 0.0)
    with pytest.raises(ValueError, match="3 episodes are no whole groups of 4"):
        rule.advantages(outcomes[:3])


def test_rows_per_episode_do_not_move_the_baseline() -> None:
    # Rewards [1, 0, 0, .5] with 3, 1, 1, 2 rows. Normalised over rows the fourth would be -.172: its sign flips.
    calls = [[call(r, [r], [9]) for r in range(rows)] for rows in (3, 1, 1, 2)]
    episodes = [episode(c, [v], rollout=i) for i, (c, v) in enumerate(zip(calls, (1.0, 0.0, 0.0, 0.5), strict=True))]
    rows = credited(episodes, group=4).rows
    # Mean .375, sample deviation .4787 + 1e-4.
    assert [round(r.advantage, 3) for r in rows] == [1.305] * 3 + [-0.783] * 2 + [0.261] * 2  # type: ignore[arg-type]


def test_call_heavy_rollouts_do_not_weigh_more() -> None:
    # Rollout 0 trains 2 tokens in one row, rollout 1 trains 8 in two rows; rewards 1 and 0.
    light = episode([call(0, [1], [2, 3])], [1.0])
    heavy = episode([call(0, [1], [4, 5, 6]), call(1, [9], [4, 5, 6, 7, 8])], [0.0], rollout=1)
    assert [r.advantage for r in credited([light, heavy], estimator="centred").rows] == [0.5, -0.5, -0.5]
    rows = credited([light, heavy], estimator="centred", normalize="rollout").rows
    # N = 10 tokens, R = 2 rollouts: factors 10 / (2 * 2) = 2.5 and 10 / (2 * 8) = 0.625.
    assert [r.advantage for r in rows] == [1.25, -0.3125, -0.3125]
    # What each rollout adds to sum(A) / N is then 1 / R of its advantage: .5 / 2 and -.5 / 2.
    sums = [sum(r.advantage * r.sequence.trained for r in rows if r.episode == e) / 10 for e in (0, 1)]  # type: ignore[operator]
    assert sums == [0.25, -0.25]


def test_step_advantages_are_scaled_token_by_token() -> None:
    light = episode([call(0, [1], [2], step=0)], [2.0])
    heavy = episode([call(0, [1], [4, 5, 6], step=0)], [0.0], rollout=1)
    plain = credited([light, heavy], estimator="reward_to_go").rows
    rows = credited([light, heavy], estimator="reward_to_go", normalize="rollout").rows
    # N = 4, R = 2: factors 4 / 2 = 2 and 4 / 6.
    for row, before, factor in zip(rows, plain, (2.0, 4 / 6), strict=True):
        assert row.advantage == tuple(a * factor for a in before.advantage)  # type: ignore[union-attr]


@pytest.mark.parametrize("estimator", ["reward_to_go", "gigpo"])
def test_equal_totals_earned_at_different_times_have_a_gradient(estimator: str) -> None:
    """A group is skipped by the advantages its estimator gives, not by its totals."""
    early = episode([call(0, [1], [2], step=0), call(1, [1, 2], [3], step=1)], [1.0, 0.0])
    late = episode([call(0, [1], [4], step=0), call(1, [1, 4], [5], step=1)], [0.0, 1.0], rollout=1)
    result = credited([early, late], estimator=estimator, skip_zero_variance=True)
    # Reward-to-go [1, 0] and [1, 1]: the second steps differ (for gigpo they were taken in the same state, "t1").
    assert result.metrics["groups/zero_variance"] == 0.0
    assert [row.zero_gradient for row in result.rows] == [False, False]
    # By totals there is nothing to learn, and an estimator per episode skips the group.
    skipped = credited([early, late], skip_zero_variance=True)
    assert skipped.rows == [] and skipped.metrics["groups/zero_variance"] == 1.0


@pytest.mark.parametrize("estimator", ["grpo", "reward_to_go"])
def test_a_call_after_the_last_step_earns_nothing(estimator: str) -> None:
    # A memory stores step 0 (the call stands at step 1) and step 1, the last (at step 2, which never came).
    def rollout(value: float, i: int) -> Trajectory:
        calls = [
            call(0, [1], [2 + i], step=0),
            call(1, [7], [8], module="memory.x", purpose="store", step=1),
            call(2, [1, 2 + i], [3], step=1),
            call(3, [7, 7], [8], module="memory.x", purpose="store", step=2),
        ]
        return episode(calls, [value, 0.0], rollout=i)

    rows = credited(
        [rollout(1.0, 0), rollout(0.0, 1)], estimator=estimator, train=TrainFilter(("reasoning.*", "memory.*"))
    ).rows
    assert [sorted(set(r.sequence.calls) - {-1}) for r in rows] == [[0, 2], [1], [0, 2], [1]]
    if estimator == "reward_to_go":
        # What was stored after step 0 earns from step 1 on: nothing here, where step 0 paid.
        assert all(row.zero_gradient for row in rows if 1 in row.sequence.calls)


def test_only_losses_over_all_tokens_can_be_normalised_by_rollout(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="normalize 'rollout' with loss_type 'grpo'"):
        config(tmp_path, normalize="rollout", loss_type="grpo").check()
