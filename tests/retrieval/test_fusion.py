"""Fusion of rankings, with numbers."""

from __future__ import annotations

import pytest

from agentspec.retrieval import min_max, mmr, reciprocal_rank_fusion, weighted_fusion


def test_reciprocal_rank_fusion_numbers():
    # Ranks 1 and 3: 1/(60+1) + 1/(60+3) = .0323; with constant 0: 1 + 1/3 = 1.333
    rankings = [[(7, 9.0), (8, 1.0)], [(1, 3.0), (2, 2.0), (7, 1.0)]]
    assert dict(reciprocal_rank_fusion(rankings))[7] == pytest.approx(1 / 61 + 1 / 63)
    assert dict(reciprocal_rank_fusion(rankings, constant=0.0))[7] == pytest.approx(4 / 3)
    assert reciprocal_rank_fusion(rankings)[0][0] == 7


def test_weighted_fusion_scales_each_ranking():
    # first: {1: 1, 2: 0}; second: {2: 1, 3: 0}; 0.7 and 0.3 -> 1: .7, 2: .3, 3: 0
    fused = weighted_fusion([(0.7, [(1, 10.0), (2, 5.0)]), (0.3, [(2, 0.2), (3, 0.1)])])
    assert fused == [(1, pytest.approx(0.7)), (2, pytest.approx(0.3)), (3, 0.0)]


def test_equal_scores_are_half():
    assert min_max({1: 3.0, 2: 3.0}) == {1: 0.5, 2: 0.5}
    assert min_max({}) == {}


def test_mmr_passes_over_a_near_copy():
    # After 1: item 2 (copy): .7*.9 - .3*1 = .33; item 3: .7*.6 - .3*0 = .42
    alike = {(2, 1): 1.0, (3, 1): 0.0}
    assert mmr([(1, 1.0), (2, 0.9), (3, 0.6)], lambda a, b: alike[a, b], 2) == [(1, 1.0), (3, 0.6)]
