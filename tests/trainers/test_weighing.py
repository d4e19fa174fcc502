"""Credit of whole rollouts: normalisation by rollout, exact numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("trl")

from agentspec.registry import SpecError
from rewards import RewardSet
from tests.trainers.builders import call, episode
from trainers.config import ScaffoldConfig
from trainers.weighing import weigh


def config(tmp_path: Path, **changes: object) -> ScaffoldConfig:
    return ScaffoldConfig(output_dir=str(tmp_path), use_cpu=True, bf16=False, num_generations=2, **changes)  # type: ignore[arg-type]


def test_call_heavy_rollouts_do_not_weigh_more(tmp_path: Path) -> None:
    # Rollout 0 trains 2 tokens in one row, rollout 1 trains 8 in two rows; rewards 1 and 0.
    light = episode([call(0, [1], [2, 3])], [1.0])
    heavy = episode([call(0, [1], [4, 5, 6]), call(1, [9], [4, 5, 6, 7, 8])], [0.0], rollout=1)
    by_token = weigh([light, heavy], config(tmp_path, estimator="centred"), RewardSet(), group=2).rows
    assert [r.advantage for r in by_token] == [0.5, -0.5, -0.5]
    rows = weigh([light, heavy], config(tmp_path, estimator="centred", normalize="rollout"), RewardSet(), group=2).rows
    # N = 10 tokens, R = 2 rollouts: factors 10 / (2 * 2) = 2.5 and 10 / (2 * 8) = 0.625.
    assert [r.advantage for r in rows] == [1.25, -0.3125, -0.3125]
    # What each rollout adds to sum(A) / N is then 1 / R of its advantage: .5 / 2 and -.5 / 2.
    sums = [sum(r.advantage * r.sequence.trained for r in rows if r.episode == e) / 10 for e in (0, 1)]  # type: ignore[operator]
    assert sums == [0.25, -0.25]


def test_step_advantages_are_scaled_token_by_token(tmp_path: Path) -> None:
    light = episode([call(0, [1], [2], step=0)], [2.0])
    heavy = episode([call(0, [1], [4, 5, 6], step=0)], [0.0], rollout=1)
    settings = config(tmp_path, estimator="reward_to_go", normalize="rollout")
    plain = weigh([light, heavy], config(tmp_path, estimator="reward_to_go"), RewardSet(), group=2).rows
    rows = weigh([light, heavy], settings, RewardSet(), group=2).rows
    # N = 4, R = 2: factors 4 / 2 = 2 and 4 / 6.
    for row, before, factor in zip(rows, plain, (2.0, 4 / 6), strict=True):
        assert row.advantage == tuple(a * factor for a in before.advantage)  # type: ignore[union-attr]


def test_only_losses_over_all_tokens_can_be_normalised_by_rollout(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="normalize 'rollout' with loss_type 'grpo'"):
        config(tmp_path, normalize="rollout", loss_type="grpo").check()
